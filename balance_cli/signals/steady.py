"""From which period on a periodic record is steady, line by line.

A transient of poles lambda is a sum of exp(lambda t): from one period to the next, of length T, every line of its
spectrum shrinks by the same factor exp(lambda T). Differences of consecutive periods show it against the noise, and
where they no longer do, its decay so far tells how much of it is left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.noise import distances, pooled_covariance, window_sums

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Counts = NDArray[np.intp]

BAND_LINES = 5
FALSE_ALARM = 1e-3
LARGEST_BIAS = 0.05
KEPT_PERIODS = 2


@dataclass(frozen=True)
class SteadyStart:
    """`first` (K,) steady period of each line; `bias` (K,): square of what the transient still adds to the mean, over

    the variance of that mean; `steady` (K,): False where more had to be accepted in order to keep two periods.
    """

    first: Counts
    bias: Array
    steady: NDArray[np.bool_]


def steady_start(spectra: ComplexArray) -> SteadyStart:
    """Find the first steady period of each line; spectra (P, K, n) of P >= 2 consecutive periods.

    The statistic is the squared difference of consecutive periods, weighted by the noise of the late ones, summed over
    all n signals and a band of few lines: chi-square distributed where nothing but noise differs. A band is unsteady
    up to the last difference that is significant (probability FALSE_ALARM for the whole record), and then until
    the decay seen so far has brought the expected bias of the mean below LARGEST_BIAS of its variance.
    """
    P, K, _ = spectra.shape
    if P <= KEPT_PERIODS:
        return SteadyStart(np.zeros(K, np.intp), np.zeros(K), np.full(K, False))
    excess, threshold = _excess(spectra)
    last = _last_significant(excess > threshold)
    predicted = _predicted(excess, last, P)
    decay = np.sqrt(_ratio(excess, last))
    kept = P - np.arange(P)[:, None]
    bias = 2.0 * predicted / (kept * (1.0 - decay) ** 4)
    allowed = (bias <= LARGEST_BIAS) & (np.arange(P)[:, None] > last)
    allowed[P - KEPT_PERIODS :] = True
    first = np.argmax(allowed, axis=0)
    left = np.where(last < 0, 0.0, bias[first, np.arange(K)])
    return SteadyStart(first, np.minimum(left, 1.0), left <= LARGEST_BIAS)


def _excess(spectra: ComplexArray) -> tuple[Array, float]:
    """Power of the differences over that of noise, less one (P-1, K), and its significance threshold."""
    from scipy.stats import chi2

    difference = np.diff(spectra, axis=0)
    n = spectra.shape[2]
    outer = np.einsum("pki,pkj->pkij", difference, difference.conj())
    late = outer[-2:]
    # Consecutive differences share a period: two of them are worth 1.6 independent ones (correlation -1/2).
    counts = np.full(spectra.shape[1], 1.6 if len(late) == 2 else 1.0)
    noise, dof = pooled_covariance(late.mean(axis=0) * counts[:, None, None], counts)
    ones = np.ones(spectra.shape[1])
    power = np.array([distances(each, noise, ones, dof) for each in outer])
    width = min(BAND_LINES, spectra.shape[1])
    banded = window_sums(power.T, width).T / width
    freedoms = 2 * n * width
    probability = FALSE_ALARM / banded.size
    return banded - 1.0, float(chi2.isf(probability, freedoms) / freedoms) - 1.0


def _last_significant(significant: NDArray[np.bool_]) -> Counts:
    """Last difference (K,) before the first two in a row that are not significant; -1 where none is."""
    quiet = ~significant
    twice = quiet & np.vstack([quiet[1:], np.ones_like(quiet[:1])])
    ends = np.vstack([twice, np.ones_like(twice[:1])])
    return np.argmax(ends, axis=0) - 1


def _ratio(excess: Array, last: Counts) -> Array:
    """Decay of the transient's power from one period to the next (K,), from the last significant difference."""
    lines = np.arange(excess.shape[1])
    later = np.where(last > 0, last, np.minimum(1, len(excess) - 1))
    early = np.maximum(excess[later - 1, lines], 1e-12)
    return np.clip(excess[later, lines] / early, 1e-9, 0.8)


def _predicted(excess: Array, last: Counts, periods: int) -> Array:
    """Excess power (P, K) that the transient has at each period, carried on from the last significant difference."""
    start = np.maximum(last, 0)
    known = np.maximum(excess[start, np.arange(excess.shape[1])], 0.0) * (last >= 0)
    elapsed = np.arange(periods)[:, None] - start
    return np.asarray(known * _ratio(excess, last) ** np.maximum(elapsed, 0))
