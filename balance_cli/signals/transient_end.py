"""The end of the start transient of a record: the first revolution that is like the later ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run, read_channels
from balance_cli.signals import distributions as stats
from balance_cli.signals.rotor.azimuth import Azimuth
from balance_cli.signals.run_samples import sample_rate

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Array = NDArray[np.float64]

COMPARED_LAGS = (3, 4)
"""Lags [revolutions] at which revolutions are compared: long enough to show a decay, short compared with a maneuver.
A signal with whole cycles in both 3 and 4 revolutions has whole cycles in one, and is a rotor harmonic."""
MAX_LAG = max(COMPARED_LAGS)
SMOOTHING_REVOLUTIONS = 5
"""Revolutions over which the energy is averaged, so that turbulence does not scatter it much."""
LATE_REVOLUTIONS = 200
"""Revolutions at the end of the record from which the steady energy comes: ample for a quantile."""
LATE_SHARE = 0.25
"""Share of the record at its end that is never discarded."""
EXAMINED_REVOLUTIONS = 48
"""Revolutions from the start on that are examined at a time: most transients have ended after so many."""
STEADY_QUANTILE = 0.9
"""Quantile of the late energies that counts as steady: a changing speed or a late step may be among them."""
FALSE_ALARM = 1e-2
"""Probability by which a channel exceeds its steady energy though it is steady: some channel of many then costs a few
revolutions, and what is left of a transient is no larger than what gusts do."""
LEAST_SCATTER = 1e-12
"""Squared relative scatter of the energies, at least: that of records without noise may be zero."""
SPLINE_DECAY = float(np.sqrt(3.0)) - 2.0
"""Effect of a sample on a cubic spline through evenly spaced samples, one step further away."""
SPLINE_REACH = 12
"""Steps after which it is neglected: 1.4e-7 is left, a hundredth of the least noise that is assumed."""
MIN_RELATIVE_NOISE = 1e-5
"""Least noise relative to the signal, for computed records without noise."""


def find_transient_end(run: Run, azimuth: Azimuth, limit: float, names: Sequence[str]) -> int:
    """Return the first revolution of the run without start transient; 0 where the record is too short to tell.

    The search ends at `limit` [s from the first sample], because the caller knows the slowest decay, and before the
    last quarter of the record. `names` are the channels to test; their samples must be finite.

    Each revolution is compared with the third and the fourth after it, at the same azimuth. The difference cancels
    signals that repeat in every revolution, and nearly cancels slow changes; decaying signals and those that are not
    rotor harmonics remain. The mean square of the difference of each channel is compared with its size late in the
    record. The first revolution at which no channel exceeds that is steady. A later step or maneuver is not tested; at
    worst it increases the size late in the record.
    """
    names = tuple(names)
    last = int(min(float(np.searchsorted(_revolution_starts(azimuth), limit)), (1 - LATE_SHARE) * azimuth.turns))
    if last < 1 or azimuth.turns - last <= 2 * MAX_LAG:
        return 0
    points = _points_per_revolution(run, azimuth)
    span = (max(last, azimuth.turns - LATE_REVOLUTIONS), azimuth.turns)
    resampled = _resample_revolutions(run, azimuth, names, span, points)
    late = _difference_energy(resampled)
    largest: Array = _largest_excess(late, points) * _steady_energy(_average_energy(late), resampled[0])
    steady = _first_steady(largest, run, azimuth, names, last, points)
    return last if steady is None else steady


def _first_steady(
    limit: Array, run: Run, azimuth: Azimuth, names: tuple[str, ...], last: int, points: int
) -> int | None:
    """Return the first revolution up to `last` in which no energy exceeds its limit (c,), None without any."""
    for begin in range(0, last + 1, EXAMINED_REVOLUTIONS):
        span = (begin, min(begin + EXAMINED_REVOLUTIONS, last + 1))
        energy = _average_differences(run, azimuth, names, span, points)
        steady = np.flatnonzero(np.all(energy <= limit, axis=1))
        if steady.size:
            return begin + int(steady[0])
    return None


def _average_differences(
    run: Run, azimuth: Azimuth, names: tuple[str, ...], span: tuple[int, int], points: int
) -> Array:
    """Return the mean energy (r, c) of the differences from each revolution of a span on."""
    needed = (span[0], span[1] + MAX_LAG + SMOOTHING_REVOLUTIONS - 1)
    return _average_energy(_difference_energy(_resample_revolutions(run, azimuth, names, needed, points)))


def _revolution_starts(azimuth: Azimuth) -> Array:
    """Return the times [s] at which the revolutions begin."""
    return azimuth.time_of(np.arange(azimuth.turns))


def _points_per_revolution(run: Run, azimuth: Azimuth) -> int:
    """Return the number of points of comparison in a revolution, about one per sample."""
    return max(4, int(sample_rate(run) / azimuth.mean_rate))


def _resample_revolutions(
    run: Run, azimuth: Azimuth, names: tuple[str, ...], span: tuple[int, int], points: int
) -> Array:
    """Return the signals at equal steps of azimuth (revolutions, points, c), by a cubic spline through the samples."""
    first, last = max(span[0], 0), min(span[1], azimuth.turns)
    position = azimuth.time_of(first + np.arange((last - first) * points) / points) * sample_rate(run)
    low, high = int(position[0]) - SPLINE_REACH, int(position[-1]) + SPLINE_REACH + 2
    samples = read_channels(run, names, max(low, 0), min(high, run.samples))
    samples = _extend(samples, max(-low, 0), max(high - run.samples, 0))
    return np.asarray(_spline_matrix(position - low, high - low) @ samples).reshape(last - first, points, len(names))


def _extend(samples: Array, before: int, after: int) -> Array:
    """Return samples (n, c) with further ones at either end, on the cubic polynomials through the four outermost."""
    nodes = np.vander(np.arange(4.0))

    def outside(outermost: Array, count: int) -> Array:
        return np.asarray(np.vander(-np.arange(count, 0.0, -1.0), 4) @ np.linalg.solve(nodes, outermost))

    if not before and not after:
        return samples
    return np.concatenate([outside(samples[:4], before), samples, outside(samples[:-5:-1], after)[::-1]])


def _spline_matrix(position: Array, samples: int) -> csr_array:
    """Return the matrix (m, samples) that evaluates cubic splines through samples at positions (m,) in units of a step.

    In such a spline the effect of a sample falls off by a factor of 3.7 a step (Unser, IEEE Signal Processing Magazine
    16, 1999, no. 6, 22): no system of equations is needed. The positions stay SPLINE_REACH away from the ends.
    """
    from scipy.sparse import csr_array

    nearest = np.floor(position).astype(np.int32)
    f = position - nearest
    pieces = np.stack([(1 - f) ** 3, (3 * f - 6) * f**2 + 4, ((3 - 3 * f) * f + 3) * f + 1, f**3], axis=1) / 6.0
    step = np.arange(-SPLINE_REACH, SPLINE_REACH + 2, dtype=np.int32)
    influence = np.sqrt(3.0) * SPLINE_DECAY ** np.abs(np.arange(-1, 3)[:, None] - step)
    index, starts = nearest[:, None] + step, np.arange(len(position) + 1, dtype=np.int32) * len(step)
    return csr_array(((pieces @ influence).ravel(), index.ravel(), starts), shape=(len(position), samples))


def _difference_energy(x: Array) -> Array:
    """Return the mean squares (r - MAX_LAG, c) of differences of r revolutions (r, points, c), summed over the lags."""
    rows = len(x) - MAX_LAG
    differences = (x[lag : lag + rows] - x[:rows] for lag in COMPARED_LAGS)
    squares = [np.einsum("rpc,rpc->rc", difference, difference) for difference in differences]
    return np.asarray(sum(squares) / x.shape[1])


def _average_energy(energy: Array) -> Array:
    """Return the mean over `SMOOTHING_REVOLUTIONS` from each revolution on, where as many follow."""
    window = np.lib.stride_tricks.sliding_window_view(energy, min(SMOOTHING_REVOLUTIONS, len(energy)), axis=0)
    return np.asarray(window.mean(axis=-1))


def _largest_excess(late: Array, points: int) -> Array:
    """Return the factor (c,) on the steady energy that a mean over revolutions exceeds with probability FALSE_ALARM.

    Noise that is white within a revolution has as many degrees of freedom as points; the motion of a light mode, and
    gusts slower than a revolution, have few. The variance of a mean of `late` (r, c) energies tells them, by its
    autocovariance; the mean that is subtracted takes its share out of it.
    """
    rows, count = len(late), min(SMOOTHING_REVOLUTIONS, len(late))
    departure = late / np.maximum(late.mean(axis=0), np.finfo(float).tiny) - 1.0
    products = np.array([np.mean(departure[: rows - k] * departure[k:], axis=0) for k in range(count)])
    correlated = products[0] + 2.0 * (1.0 - np.arange(1, count) / SMOOTHING_REVOLUTIONS) @ products[1:]
    variance = np.maximum(correlated, products[0]) / SMOOTHING_REVOLUTIONS
    variance = np.maximum(variance, np.median(variance)) * (1.0 + SMOOTHING_REVOLUTIONS / rows)
    dof = np.minimum(2.0 / np.maximum(variance, LEAST_SCATTER), SMOOTHING_REVOLUTIONS * points)
    return np.asarray(stats.f.isf(FALSE_ALARM, dof, dof * rows / SMOOTHING_REVOLUTIONS))


def _steady_energy(later: Array, signal: Array) -> Array:
    """Return the energy (c,) of the steady part, a quantile of those late in the record.

    `signal` (points, c) is a revolution of it, to whose size the least energy is relative.
    """
    floor = (MIN_RELATIVE_NOISE * np.std(signal, axis=0)) ** 2 + np.finfo(float).tiny
    return np.asarray(np.maximum(np.quantile(later, STEADY_QUANTILE, axis=0), floor))
