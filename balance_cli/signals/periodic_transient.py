"""The first steady period of a periodic record, for each spectral line.

A transient with poles lambda is a sum of exp(lambda t): from one period to the next, of length T, every line of its
spectrum decreases by the factor exp(lambda T). Differences of consecutive periods show it against the noise; where they
are no longer significant, the decay up to there predicts the remainder. Two statistics are tested: all signals together
in narrow bands (the transient of a mode is in all of them), and each signal by itself in wide bands (the transient of
the high-pass of one channel).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.io.errors import UserError
from balance_cli.signals.covariance_pooling import (
    pooled_covariance,
    variance_floor,
    window_sums,
)
from balance_cli.signals.run_samples import run_error, sample_rate

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Counts = NDArray[np.intp]

NARROW_LINES = 5
"""Lines of a narrow band: about the width of a lightly damped resonance."""
WIDE_LINES = 41
"""Lines of a wide band: the transient of a high-pass is broad, and a single signal needs the average."""
FALSE_ALARM = 1e-2
"""Probability that noise makes any band of a record unsteady."""
LARGEST_BIAS = 0.05
"""Largest expected squared bias of a mean over its variance: the total error grows by 2.5 %."""
LARGEST_BIAS_OF_SIGNAL = 0.25
"""The same for one signal in wide bands: the total error of that signal grows by 12 %."""
MIN_PERIODS = 2
"""Periods that are kept at least: their difference is the only estimate of the noise."""
DECAY_RATIO_QUANTILE = 0.9
"""Quantile of the known decay ratios that bounds those which noise alone determines."""
DEFAULT_DECAY_RATIO = 0.1
"""Bound of the decay ratio where no line of the record determines one."""
MAX_DECAY_RATIO = 0.6
"""Largest decay ratio: for slower decays the factor (1 - sqrt(ratio))^-4 of the bias is above 390."""


@dataclass(frozen=True)
class SteadyStart:
    """`first` (K,) steady period of each line.

    `bias` (K,): expected squared bias of the mean over its variance; `steady` (K,): False where a larger bias is
    accepted in order to keep two periods.
    """

    first: Counts
    bias: Array
    steady: NDArray[np.bool_]


@dataclass(frozen=True)
class _BandStatistic:
    """Power of the differences over that of noise, less one: `excess` (P-1, K, v), and its significance threshold."""

    excess: Array
    threshold: float
    largest_bias: float


def find_steady_start(spectra: ComplexArray, channels: int) -> SteadyStart:
    """Find the first steady period of each line; spectra (P, K, n), channels first, of P >= 2 consecutive periods.

    The statistic is the squared difference of consecutive periods, weighted by the noise of the last one: chi-square
    distributed if only noise differs. A band is unsteady up to the last significant difference (`FALSE_ALARM` for the
    whole record), and then until the decay up to there has reduced the expected squared bias of the mean below
    `LARGEST_BIAS` of its variance (`LARGEST_BIAS_OF_SIGNAL` in each signal).
    """
    P, K, _ = spectra.shape
    if P <= MIN_PERIODS:
        return SteadyStart(np.zeros(K, np.intp), np.zeros(K), np.full(K, False))
    statistics = _band_statistics(spectra, channels)
    biases = [_bias(item, P) for item in statistics]
    allowed = np.all([np.all(b <= s.largest_bias, axis=2) for b, s in zip(biases, statistics, strict=True)], axis=0)
    is_steady = np.copy(allowed)
    allowed[P - MIN_PERIODS :] = True
    first = np.argmax(allowed, axis=0)
    lines = np.arange(K)
    return SteadyStart(first, np.minimum(biases[0][first, lines, 0], 1.0), is_steady[first, lines])


def _band_statistics(spectra: ComplexArray, channels: int) -> tuple[_BandStatistic, _BandStatistic]:
    """Return the statistics of all signals together in narrow bands, and of each by itself in wide ones."""
    difference = np.diff(spectra, axis=0)
    K, n = spectra.shape[1:]
    # The last difference alone: a transient in the one before would pass for noise, which then hides it.
    floor = 2.0 * variance_floor(spectra, channels)
    noise = pooled_covariance(difference[-1:].swapaxes(0, 1), np.ones(K), floor=floor)
    joint_power = noise.distances(difference.swapaxes(0, 1)).T[:, :, None] / n
    variance = np.diagonal(noise.knots, axis1=1, axis2=2).real[noise.nearest]
    signal_power = (difference.real**2 + difference.imag**2) / variance
    narrow = _average_over_band(joint_power, NARROW_LINES, n, noise.dof, LARGEST_BIAS)
    return narrow, _average_over_band(signal_power, WIDE_LINES, 1, noise.dof, LARGEST_BIAS_OF_SIGNAL)


def _average_over_band(power: Array, lines: int, signals: int, dof: float, largest_bias: float) -> _BandStatistic:
    """Average power (P-1, K, v) over that of noise with `dof` over bands of `lines`; the ratio is F distributed."""
    from balance_cli.signals.distributions import f

    width = min(lines, power.shape[1])
    banded = window_sums(power.swapaxes(0, 1), width).swapaxes(0, 1) / width
    tests = max(banded.size // width, 1)
    largest = float(f.isf(FALSE_ALARM / tests, 2 * signals * width, 2 * signals * dof))
    return _BandStatistic(banded - 1.0, largest - 1.0, largest_bias)


def _bias(statistic: _BandStatistic, periods: int) -> Array:
    """Return the expected squared bias of the mean over its variance (P, K, v), for each first period.

    An excess e in the difference of periods p and p+1 is a transient of size |t|^2 = 2 e sigma^2 / (1 - decay)^2; the
    mean over m periods contains t / (m (1 - decay)) of it, and has the variance sigma^2 / m. Where the transient is
    still significant in the first period, the bias is infinite.
    """
    last = _last_significant(statistic.excess > statistic.threshold)
    ratio = _decay_ratio(statistic.excess, last)
    remaining = periods - np.arange(periods)[:, None, None]
    transient = _extrapolate_transient(statistic.excess, last, ratio, periods)
    bias = 2.0 * transient / (remaining * (1.0 - np.sqrt(ratio)) ** 4)
    return np.where(np.arange(periods)[:, None, None] > last, bias, np.inf)


def _last_significant(significant: NDArray[np.bool_]) -> Counts:
    """Return the last difference (K, v) before the first two consecutive insignificant ones; -1 where none is."""
    insignificant = ~significant
    both = insignificant & np.concatenate([insignificant[1:], np.ones_like(insignificant[:1])])
    ends = np.concatenate([both, np.ones_like(both[:1])])
    return np.asarray(np.argmax(ends, axis=0) - 1, np.intp)


def _take_period(values: Array, period: Counts) -> Array:
    return np.asarray(np.take_along_axis(values, period[None], axis=0)[0])


def _decay_ratio(excess: Array, last: Counts) -> Array:
    """Return the ratio (K, v) of the power of the transient in consecutive periods, at the last significant difference.

    Where only the first difference is significant, noise determines the ratio; there it is limited by a quantile of the
    known ones.
    """
    later = np.where(last > 0, last, min(1, len(excess) - 1))
    early = np.maximum(_take_period(excess, np.maximum(later - 1, 0)), 1e-12)
    ratio = np.clip(_take_period(excess, later) / early, 1e-9, MAX_DECAY_RATIO)
    known = ratio[last > 0]
    limit = np.quantile(known, DECAY_RATIO_QUANTILE) if known.size else DEFAULT_DECAY_RATIO
    return np.asarray(np.where(last > 0, ratio, np.minimum(ratio, limit)), float)


def _extrapolate_transient(excess: Array, last: Counts, ratio: Array, periods: int) -> Array:
    """Return the excess power (P, K, v) of the transient in each period, from the last significant difference on."""
    start = np.maximum(last, 0)
    known = np.maximum(_take_period(excess, start), 0.0) * (last >= 0)
    elapsed = np.arange(periods)[:, None, None] - start
    return np.asarray(known * ratio ** np.maximum(elapsed, 0))


# ---- Periods whose loads are unlike the others: a spike, an exciter that stops --------------------------------------

ALIKE, DIFFERENT = 0.1, 0.3
"""Distance of the loads of a period from the median over the periods, over its size: below the first a period is like
the others, above the second it is not. Loads that have another period than declared differ by 1.4 in all of them."""
FEWEST_PERIODS = 3
"""Periods from which a median is that of most."""


def deviating_periods(loads: ComplexArray) -> tuple[int, ...]:
    """Return the numbers of the periods whose loads (P, K, u) differ from those that most have; empty without most."""
    if len(loads) < FEWEST_PERIODS:
        return ()
    median = np.median(loads.real, axis=0) + 1j * np.median(loads.imag, axis=0)
    size = float(np.linalg.norm(median))
    distance = np.linalg.norm((loads - median).reshape(len(loads), -1), axis=1)
    alike = np.count_nonzero(distance < ALIKE * size)
    return tuple(int(p) for p in np.flatnonzero(distance > DIFFERENT * size)) if 2 * alike > len(loads) else ()


def no_common_line(run: Run, loads: ComplexArray) -> UserError:
    """Return the error of a record whose loads (P, K, u) have no line in common; periods end with the record."""
    fault, periods = "no line of the loads repeats from period to period", deviating_periods(loads)
    if not periods:
        return run_error(run, fault, "Check `period` and `sample_rate`", "attribute `period`")
    return _unlike_loads(run, f"{fault}: ", periods, len(loads))


def require_like_loads(run: Run, loads: ComplexArray, first: int) -> None:
    """Raise UserError where loads (P, K, u) of periods from `first` on, which are used, are unlike those of most."""
    periods = tuple(p for p in deviating_periods(loads) if p >= first)
    if periods:
        raise _unlike_loads(run, "", periods, len(loads))


def _unlike_loads(run: Run, fault: str, periods: Sequence[int], count: int) -> UserError:
    """The error that names these periods by their times."""
    rate = sample_rate(run)
    step = run.samples // count / rate
    begin = run.samples / rate - count * step
    parts = ", ".join(f"{begin + p * step:.4g} to {begin + (p + 1) * step:.4g} s" for p in periods)
    text = f"{fault}the loads from {parts} are unlike those of most of the {count} periods"
    return run_error(run, text, "Look there for a spike or an exciter that stopped, and cut the record", "loads")
