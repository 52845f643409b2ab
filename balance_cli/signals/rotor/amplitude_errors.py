"""Errors of rotor harmonics beside the noise of the record: by the scatter of the pulses, and by bridged gaps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.signals.rotor.azimuth import Azimuth

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Integers = NDArray[np.int64]


def azimuth_error_covariance(amplitude: ComplexArray, azimuth: Azimuth, revolutions: float) -> ComplexArray:
    """Return the covariance (n+1, c, c) of harmonics (n+1, c) over `revolutions`, by the scatter of the pulses.

    The mean error of the azimuth, that of all pulses alike included, turns harmonic k by k times as much; the error
    that varies within the interval reduces its amplitude by half the square. The variance is doubled because it is that
    of a circular error, of which a cosine has half, and a turn may lie in the cosine alone.
    """
    k = np.arange(len(amplitude))
    mean_error = azimuth.pulse_scatter**2 / revolutions + azimuth.common_error**2
    share = k**2 * mean_error + 0.25 * (k * azimuth.local_error) ** 4
    return np.asarray(2.0 * share[:, None, None] * amplitude[:, :, None] * amplitude[:, None, :].conj())


def bridging_covariance(
    run: Run, names: tuple[str, ...], span: tuple[int, int], amplitudes_of: Callable[[Integers, Array], ComplexArray]
) -> ComplexArray | float:
    """Return the covariance (n+1, c, c) of harmonics that follows from the gaps among samples `span`; 0 without any.

    `amplitudes_of(index, values)` returns the harmonics (k, n+1) of signals that are `values` (k, m) at the samples
    `index` (m,) and zero elsewhere. The errors are those that the same interpolation makes beside the gaps, displaced
    by about the same number of samples in all channels, so that errors common to them are kept.
    """
    low, high = span
    inside = [item.excerpt(low, high) for item in run.bridged if item.name in names]
    errors = [(names.index(item.name), amplitudes_of(low + item.index, item.errors)) for item in inside if item.count]
    if not errors:
        return 0.0
    displaced, harmonics = errors[0][1].shape
    amplitude = np.zeros((displaced, harmonics, len(names)), complex)
    for column, values in errors:
        amplitude[:, :, column] = values
    return np.asarray(np.einsum("khi,khj->hij", amplitude, amplitude.conj()) / displaced)
