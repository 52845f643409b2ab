"""From which period on a periodic record is steady, line by line.

A transient of poles lambda is a sum of exp(lambda t): from one period to the next, of length T, every line of its
spectrum shrinks by the same factor exp(lambda T). Differences of consecutive periods show it against the noise, and
where they no longer do, its decay so far tells how much of it is left. They are looked at in two ways: all signals
together in narrow bands (the ringing of a mode is in all of them), and each signal by itself in wide bands (the
recovery of one channel's high-pass).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.covariance_pooling import (
    pooled_covariance,
    variance_floor,
    vector_mahalanobis_distances,
    window_sums,
)

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Counts = NDArray[np.intp]

NARROW_LINES = 5
WIDE_LINES = 41
FALSE_ALARM = 1e-2
LARGEST_BIAS = 0.05
LARGEST_BIAS_OF_SIGNAL = 0.25
MIN_PERIODS = 2
DECAY_RATIO_QUANTILE = 0.9
DEFAULT_DECAY_RATIO = 0.1
MAX_DECAY_RATIO = 0.6


@dataclass(frozen=True)
class SteadyStart:
    """`first` (K,) steady period of each line; `bias` (K,): square of what the transient still adds to the mean, over

    the variance of that mean; `steady` (K,): False where more had to be accepted in order to keep two periods.
    """

    first: Counts
    bias: Array
    steady: NDArray[np.bool_]


@dataclass(frozen=True)
class _BandStatistic:
    """Power of the differences over that of noise, less one: excess (P-1, K, v), and its significance threshold."""

    excess: Array
    threshold: float
    largest_bias: float


def find_steady_start(spectra: ComplexArray) -> SteadyStart:
    """Find the first steady period of each line; spectra (P, K, n) of P >= 2 consecutive periods.

    The statistic is the squared difference of consecutive periods, weighted by the noise of the late ones: chi-square
    distributed where nothing but noise differs. A band is unsteady up to the last difference that is significant
    (probability FALSE_ALARM for the whole record), and then until the decay seen so far has brought the expected bias
    of the mean below LARGEST_BIAS of its variance (or LARGEST_BIAS_OF_SIGNAL in any one signal).
    """
    P, K, _ = spectra.shape
    if P <= MIN_PERIODS:
        return SteadyStart(np.zeros(K, np.intp), np.zeros(K), np.full(K, False))
    views = _band_statistics(spectra)
    biases = [_bias(view, P) for view in views]
    allowed = np.all([np.all(b <= v.largest_bias, axis=2) for b, v in zip(biases, views, strict=True)], axis=0)
    settled = np.copy(allowed)
    allowed[P - MIN_PERIODS :] = True
    first = np.argmax(allowed, axis=0)
    lines = np.arange(K)
    return SteadyStart(first, np.minimum(biases[0][first, lines, 0], 1.0), settled[first, lines])


def _band_statistics(spectra: ComplexArray) -> tuple[_BandStatistic, _BandStatistic]:
    """All signals together in narrow bands, and each by itself in wide ones."""
    difference = np.diff(spectra, axis=0)
    K, n = spectra.shape[1:]
    late = difference[-2:]
    scatter = np.einsum("pki,pkj->kij", late, late.conj()) / len(late)
    # Consecutive differences share a period: two of them are worth 1.6 independent ones (correlation -1/2).
    counts = np.full(K, 1.6 if len(late) == 2 else 1.0)
    noise, dof = pooled_covariance(scatter * counts[:, None, None], counts, floor=2.0 * variance_floor(spectra))
    together = vector_mahalanobis_distances(difference, noise, dof)[:, :, None]
    own = np.abs(difference) ** 2 / np.diagonal(noise, axis1=1, axis2=2).real
    narrow = _average_over_band(together, NARROW_LINES, n, dof, LARGEST_BIAS)
    return narrow, _average_over_band(own, WIDE_LINES, 1, dof, LARGEST_BIAS_OF_SIGNAL)


def _average_over_band(power: Array, lines: int, signals: int, dof: float, largest_bias: float) -> _BandStatistic:
    """Power (P-1, K, v) over that of noise known with `dof`, averaged over bands of `lines`: Fisher's distribution."""
    from scipy.stats import f

    width = min(lines, power.shape[1])
    banded = window_sums(power.swapaxes(0, 1), width).swapaxes(0, 1) / width
    tests = max(banded.size // width, 1)
    largest = float(f.isf(FALSE_ALARM / tests, 2 * signals * width, 2 * signals * dof))
    return _BandStatistic(banded - 1.0, largest - 1.0, largest_bias)


def _bias(view: _BandStatistic, periods: int) -> Array:
    """Expected square of the transient in the mean over its variance (P, K, v), for each period to start from.

    An excess e in the difference of periods p and p+1 is a transient of size |t|^2 = 2 e sigma^2 / (1 - decay)^2; the
    mean over m periods holds t / (m (1 - decay)) of it, and has the variance sigma^2 / m. Where there is no telling,
    because the transient is still significant at the start, it is infinite.
    """
    last = _last_significant(view.excess > view.threshold)
    ratio = _decay_ratio(view.excess, last)
    kept = periods - np.arange(periods)[:, None, None]
    bias = 2.0 * _extrapolate_transient(view.excess, last, ratio, periods) / (kept * (1.0 - np.sqrt(ratio)) ** 4)
    return np.where(np.arange(periods)[:, None, None] > last, bias, np.inf)


def _last_significant(significant: NDArray[np.bool_]) -> Counts:
    """Last difference (K, v) before the first two in a row that are not significant; -1 where none is."""
    quiet = ~significant
    twice = quiet & np.concatenate([quiet[1:], np.ones_like(quiet[:1])])
    ends = np.concatenate([twice, np.ones_like(twice[:1])])
    return np.asarray(np.argmax(ends, axis=0) - 1, np.intp)


def _take_period(values: Array, period: Counts) -> Array:
    return np.asarray(np.take_along_axis(values, period[None], axis=0)[0])


def _decay_ratio(excess: Array, last: Counts) -> Array:
    """Decay of the transient's power from one period to the next (K, v), from the last significant difference.

    Where only the first difference is significant the decay is known by noise alone; there it is not taken for slower
    than most of those that are known.
    """
    later = np.where(last > 0, last, min(1, len(excess) - 1))
    early = np.maximum(_take_period(excess, np.maximum(later - 1, 0)), 1e-12)
    ratio = np.clip(_take_period(excess, later) / early, 1e-9, MAX_DECAY_RATIO)
    known = ratio[last > 0]
    usual = np.quantile(known, DECAY_RATIO_QUANTILE) if known.size else DEFAULT_DECAY_RATIO
    return np.asarray(np.where(last > 0, ratio, np.minimum(ratio, usual)), float)


def _extrapolate_transient(excess: Array, last: Counts, ratio: Array, periods: int) -> Array:
    """Excess power (P, K, v) that the transient has at each period, carried on from the last significant difference."""
    start = np.maximum(last, 0)
    known = np.maximum(_take_period(excess, start), 0.0) * (last >= 0)
    elapsed = np.arange(periods)[:, None, None] - start
    return np.asarray(known * ratio ** np.maximum(elapsed, 0))
