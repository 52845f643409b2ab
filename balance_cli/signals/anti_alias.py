"""The analog anti-alias filter of the acquisition, through which every channel passes before it is sampled."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from balance_cli.campaign.rig.geometry import Acquisition

ComplexArray = NDArray[np.complex128]
CONTRADICTED_CUTOFF = "loads beyond the cutoff of `acquisition.filter`"
"""How the finding begins that the sweeps contradict the declared filter; responses keep it among their findings."""


def butterworth_poles(order: int) -> ComplexArray:
    """Return the poles (order,) of the analog Butterworth low-pass filter with a cut-off at 1 rad/s.

    They are evenly spaced on the left half of the unit circle (Butterworth, Wireless Engineer 7, 1930, p. 536).
    """
    k = np.arange(1, order + 1)
    return np.asarray(np.exp(1j * np.pi * (2 * k + order - 1) / (2 * order)), complex)


def anti_alias_response(acquisition: Acquisition, frequency_hz: ArrayLike) -> ComplexArray:
    """Return the response H(j 2 pi f) of the anti-alias filter, in the shape of `frequency_hz` [Hz].

    H(s) = prod_k -p_k / (s/omega_c - p_k) has unit gain at f = 0 and falling phase; H = 1 where no filter is declared.
    """
    frequency = np.asarray(frequency_hz, float)
    if acquisition.filter is None:
        return np.ones(frequency.shape, complex)
    s = 1j * frequency / acquisition.filter.cutoff
    poles = butterworth_poles(acquisition.filter.order)
    response = np.ones(frequency.shape, complex)
    for pole in poles.tolist():
        response *= -pole / (s - pole)
    return response


def is_filter_contradicted(findings: tuple[str, ...] | None) -> bool:
    """Whether the findings on the sweeps of a response contradict the declared filter, by which loads are divided."""
    return any(text.startswith(CONTRADICTED_CUTOFF) for text in findings or ())
