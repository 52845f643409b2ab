"""The anti-alias filter of the acquisition, which stands between every channel and its samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from balance_cli.campaign.rig.geometry import Acquisition

ComplexArray = NDArray[np.complex128]


def butterworth_poles(order: int) -> ComplexArray:
    """Poles (order,) of the analogue Butterworth low-pass with cut-off 1 rad/s.

    They lie evenly spaced on the left half of the unit circle (Butterworth, Wireless Engineer 7, 1930, p. 536).
    """
    k = np.arange(1, order + 1)
    return np.asarray(np.exp(1j * np.pi * (2 * k + order - 1) / (2 * order)), complex)


def anti_alias_response(acquisition: Acquisition, frequency_hz: ArrayLike) -> ComplexArray:
    """Response H(j 2 pi f) of the anti-alias filter, of the shape of `frequency_hz` [Hz]; 1 where there is none.

    H(s) = prod_k -p_k / (s/omega_c - p_k): unit gain at f = 0, falling phase.
    """
    frequency = np.asarray(frequency_hz, float)
    if acquisition.filter is None:
        return np.ones(frequency.shape, complex)
    s = 1j * frequency / acquisition.filter.cutoff
    poles = butterworth_poles(acquisition.filter.order)
    return np.asarray(np.prod(-poles / (s[..., None] - poles), axis=-1))
