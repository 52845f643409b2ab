"""What is left of a start transient in the last periods of a record, by its decay from period to period.

From one period to the next a transient decays by the same complex factor r at neighboring lines of its spectrum:
differences of consecutive periods d_p = x_(p+1) - x_p decay by it too. So d_2 - r d_1 is noise alone, and the transient
that is still in period p is d_p / (r - 1).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.covariance_pooling import window_sums
from balance_cli.signals.periodic_transient import SteadyStart

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

FEWEST_PERIODS = 3
"""Periods whose differences tell a decay."""
DECAY_LINES = 11
"""Neighboring lines whose transient is taken to decay by one factor; in their width a mode changes little."""
DIFFERENCE_DOF = 2.0 / 3.0
"""Degrees of freedom of a difference of neighboring lines: each line is in two of them (Rice, Ann. Stat. 12, 1984)."""
LEAST_INFORMATION = 0.5
"""Share of the information of the lines, from which a mean of periods is used: with less of it, most of what the record
says is lost to its transient, which a local model of the whole record estimates."""
LEAST_LOSS = 0.1
"""Least |1 - r|: a smaller one is not told from that of noise, and would make the remainder boundless."""


def deviations_from_decay(spectra: ComplexArray) -> tuple[ComplexArray, Array]:
    """Return deviations (K, 1, n) of the last periods (P, K, n) from a transient, and their degrees of freedom (K,).

    The difference d_2 - r d_1 has 1 + |1 + r|^2 + |r|^2 times the variance of one period. The transient of several
    modes far from their peaks is smooth in frequency, and is removed by differences of neighboring lines: of
    two periods, by these alone.
    """
    early, late = _last_differences(spectra)
    r = _decay_factors(spectra)
    noise = (late - r[:, None] * early) / np.sqrt(1.0 + np.abs(1.0 + r) ** 2 + np.abs(r) ** 2)[:, None]
    return _neighbor_differences(noise)[:, None, :], np.full(len(noise), DIFFERENCE_DOF)


def _last_differences(spectra: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """The last two differences (K, n) of consecutive periods; of two periods the earlier one is zero."""
    differences = np.diff(spectra, axis=0)
    return (differences[-2] if len(differences) > 1 else np.zeros_like(differences[-1])), differences[-1]


def _neighbor_differences(values: ComplexArray) -> ComplexArray:
    """Differences (K, n) of neighboring lines: where noise is white, each has DIFFERENCE_DOF times its power."""
    k = np.minimum(np.arange(len(values)), len(values) - 2)
    return np.asarray((values[k + 1] - values[k]) * np.sqrt(DIFFERENCE_DOF / 2.0))


def information_beside_transient(mean: ComplexArray, variance: Array, left: ComplexArray) -> float:
    """Return the share of the information in the mean (K, n) of the periods that a transient leaves.

    The information of a line is its power over its variance. `variance` (K, n) is that of the noise in the mean; `left`
    (K, n, n), by `transient_covariance`, contains as much.
    """
    width = min(DECAY_LINES, len(left))
    square = window_sums(np.einsum("kss->ks", left).real, width) / width
    variance = np.maximum(variance, np.finfo(float).tiny)
    power = np.abs(mean) ** 2
    return float(np.sum(power / np.maximum(square, variance)) / np.sum(power / variance))


def transient_covariance(spectra: ComplexArray, start: SteadyStart) -> ComplexArray:
    """Return the square (K, n, n) of what is left of the transient in the mean of the periods used; zero where steady.

    Lines that are not steady are the mean of the last two periods: it contains half of what these two have,
    d (1 + r) / 2 (r - 1).
    """
    r = _decay_factors(spectra)
    loss = 1.0 - r
    loss = loss * np.maximum(LEAST_LOSS / np.maximum(np.abs(loss), 1e-12), 1.0)
    left = (spectra[-2] - spectra[-1]) * ((1.0 + r) / (2.0 * loss) * ~start.steady)[:, None]
    return np.asarray(left[:, :, None] * left[:, None, :].conj())


def _decay_factors(spectra: ComplexArray) -> ComplexArray:
    """Return r (K,), at most one in size, by least squares over DECAY_LINES lines.

    Where there are enough periods, an earlier difference with independent noise is the instrumental variable. Two
    periods tell no decay: there the transient is taken to be over in the second one, r = 0.
    """
    if len(spectra) < FEWEST_PERIODS:
        return np.zeros(spectra.shape[1], complex)
    differences = np.diff(spectra, axis=0)
    early, late = differences[-2:]
    instrument = differences[-4] if len(differences) > 3 else early
    weight = 1.0 / np.maximum(np.median(np.abs(late) ** 2, axis=0), 1e-300)
    width = min(DECAY_LINES, len(late))
    common = window_sums(np.sum(instrument.conj() * late * weight, axis=1), width)
    power = window_sums(np.sum(instrument.conj() * early * weight, axis=1), width)
    r = common / np.where(power == 0, 1.0, power)
    return np.asarray(r / np.maximum(np.abs(r), 1.0))
