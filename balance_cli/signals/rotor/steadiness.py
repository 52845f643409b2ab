"""Whether amplitudes stay the same throughout a record, or step, drift or fade within it.

The record is cut into windows of whole revolutions. A regression on azimuth gives the amplitudes of each window. A
cumulative-sum test (Page, Biometrika 41, 1954, 100; Ploberger and Kraemer, Econometrica 60, 1992, 271) then asks
whether the amplitudes wander from their mean by more than the scatter from window to window explains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run, read_channels
from balance_cli.signals import distributions as stats
from balance_cli.signals.rotor.azimuth import Azimuth
from balance_cli.signals.rotor.line_sums import trigonometric_basis
from balance_cli.signals.run_samples import sample_rate

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

TARGET_WINDOWS = 48
"""Windows of a record: enough to place a step to 2 % of the record, few enough that each holds several revolutions."""
FEWEST_WINDOWS = 8
"""With fewer windows the test has no power; nothing is concluded."""
SHORT_RECORD = 24
"""Windows below which steps are sought by themselves. The cumulative sum does not tell them in a dozen windows: three
second differences of ten contain a step, and the scatter with them."""
FEWEST_BESIDE_STEP = 3
"""Windows before a step and after it, from which the scatter comes; the window within which it falls belongs to none.
"""
STEP_LIMIT, STEP_LIMIT_OF_ONE, STEP_LIMIT_OF_FEW = 14.0, 16.0, 52.0
"""Student's t of a step, over all places: 14 for two parts, for one of n windows 16 + 52/(n - 4).

By simulation of 8 to 23 windows it is reached once in 1e4 by a random walk, which is the worst of gusts, in 1e5 where
neighboring windows have a correlation of 0.8, and less than once in 1e6 where it is below 0.5.
"""
WINDOWS_PER_LAG = 12
LONGEST_LAG = 2
"""Windows over which scatter may be correlated (gusts) without being taken for a step, at most one in twelve: a drift
of two periods within a record still differs little between them."""
KEPT_SHARE, KEPT_MEAN = 0.8, 0.4377
"""Share of the squared second differences, the least ones, that the scatter comes from: a step makes few large ones, a
drift none.
Second, the mean of that share of chi-square with one degree of freedom."""
DIFFERENCE_DOF = 0.38
"""Degrees of freedom of such a scatter for each difference, by simulation."""
FALSE_ALARM = 1e-5
"""Probability by which a steady amplitude is called unsteady: records have hundreds of them."""
CRITICAL_SUM = 2.47
"""Largest cumulative sum, in units of a known scatter, that a steady amplitude exceeds with that probability.

For the Brownian bridge P(sup |B| > x) = 2 exp(-2 x^2) (Kolmogorov).
"""
MATERIAL_CHANGE = 3.0
"""Change within the record, in stated standard deviations of the mean amplitude, that makes a flag worthwhile.

A smaller change is covered by the uncertainty that the load carries anyway.
"""
WINDOWS_PER_TAPER, MOST_TAPERS = 5, 6
"""Windows of a record for each taper, and tapers at most: six see as many lines on either side of the harmonic as the
taper of the noise leaves out there."""
SLOW_FALSE_ALARM = 1e-6
"""Probability by which steady amplitudes of known noise show such a change: records have hundreds of them."""
WINDOWED_SAMPLES = 2**17
"""Samples that are read at a time: with the basis of eight harmonics 35 MB, as other arrays of a long record take."""
SAMPLES_PER_HARMONIC = 4
"""Samples of a window for each harmonic of its regression: twice its coefficients."""
LEAST_EIGENVALUE = 1e-8
"""Of the normal equations of a window, over the largest: they then leave eight digits, else least squares by singular
values are taken."""


@dataclass(frozen=True)
class WindowedAmplitudes:
    """Amplitudes (w, n+1, c) of harmonics 0 to n of c channels in w consecutive windows of `turns` revolutions.

    `speed` (w,) [Hz] is the mean rotor speed of each window.
    """

    values: ComplexArray
    names: tuple[str, ...]
    speed: Array
    turns: int


def windowed_amplitudes(
    run: Run, azimuth: Azimuth, names: Sequence[str], n: int, revolutions: tuple[int, int], regressed: int = 0
) -> WindowedAmplitudes:
    """Regress harmonics 0 to `n` of the named channels on azimuth, window by window, from one revolution to another.

    Those up to `regressed` are in the regression, as far as the samples of a window tell them: what is left out leaks.
    """
    first, last = revolutions
    length = max(1, -(-(last - first) // TARGET_WINDOWS))
    edges = np.arange(first, last + 1, length)
    times = azimuth.time_of(edges)
    samples = np.ceil(times * sample_rate(run)).astype(int)
    shortest = int(np.diff(samples).min(initial=run.samples))
    fitted = max(n, min(regressed, shortest // SAMPLES_PER_HARMONIC))
    together = max(WINDOWED_SAMPLES * (len(edges) - 1) // max(int(samples[-1] - samples[0]), 1), 1)
    groups = [samples[start : start + together + 1] for start in range(0, len(edges) - 1, together)]
    values = [np.zeros((0, n + 1, len(names)), complex)]
    values += [_amplitudes_of_group(run, azimuth, names, fitted, group.tolist())[:, : n + 1] for group in groups]
    return WindowedAmplitudes(np.concatenate(values), tuple(names), length / np.diff(times), length)


def _amplitudes_of_group(
    run: Run, azimuth: Azimuth, names: Sequence[str], n: int, samples: Sequence[int]
) -> ComplexArray:
    """Return the amplitudes (w, n+1, c) of consecutive windows between these samples (w + 1,)."""
    start, stop = samples[0], samples[-1]
    psi, _ = azimuth.of_samples(sample_rate(run), start, stop)
    basis, signals = trigonometric_basis(psi, n), read_channels(run, names, start, stop)
    cuts = [slice(a - start, b - start) for a, b in pairwise(samples)]
    return _amplitudes([basis[:, cut] for cut in cuts], [signals[cut] for cut in cuts], n)


def _amplitudes(bases: list[Array], signals: list[Array], n: int) -> ComplexArray:
    """Return the amplitudes (w, n+1, c) of w windows; harmonics above half the samples of a window are left out."""
    gram = np.array([basis @ basis.T for basis in bases])
    moment = np.array([basis @ samples for basis, samples in zip(bases, signals, strict=True)])
    spread = np.linalg.eigvalsh(gram)
    regular = spread[:, 0] > LEAST_EIGENVALUE * spread[:, -1]
    gram[~regular] = np.eye(gram.shape[1])
    solution = np.linalg.solve(gram, moment)
    for window in np.flatnonzero(~regular):
        solution[window] = np.linalg.lstsq(bases[window].T, signals[window], rcond=None)[0]
    amplitude = solution[:, : n + 1].astype(complex)
    amplitude[:, 1:] -= 1j * solution[:, n + 1 :]
    return np.asarray(amplitude)


def unsteady(values: ComplexArray, sigma: Array, correlation: Array | float = 0.0) -> NDArray[np.bool_]:
    """Which series of amplitudes (w, ...) step or drift by more than chance and by more than `sigma` (...) covers.

    `sigma` is the stated standard deviation of the mean over all windows, of one real component; `correlation` (...)
    that of neighboring windows, below one, where a mode of the rig outlasts them.
    """
    count = len(values)
    if count < FEWEST_WINDOWS:
        return np.zeros(values.shape[1:], bool)
    parts = np.stack([values.real, values.imag])
    wander = np.cumsum(parts - parts.mean(axis=1, keepdims=True), axis=1)
    largest = np.abs(wander).max(axis=1)
    used = np.where(np.any(values.imag != 0.0, axis=0), 2, 1)
    scatter = np.sqrt(sum(window_scatter(part) ** 2 for part in parts) / used)
    with np.errstate(divide="ignore", invalid="ignore"):
        excess = np.where(largest > 0, largest / (scatter * np.sqrt(count)), 0.0)
    limit = critical_sum(count, used) * correlated_scatter(correlation)
    exceeded = np.any(excess > limit, axis=0) | _has_step(parts, used)
    # The size of a change does not depend on its phase, as that of either component does.
    return np.asarray(exceeded & (largest_change(values) > MATERIAL_CHANGE * sigma))


def _has_step(parts: Array, used: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which short series (2, w, ...), of one or two parts, step by more than gusts do.

    The means before and after each window are compared by the scatter about them (Andrews, Econometrica 61, 1993, 821).
    """
    count = parts.shape[1]
    if count >= SHORT_RECORD:
        return np.zeros(parts.shape[2:], bool)
    x = parts - parts.mean(axis=1, keepdims=True)
    at = np.arange(FEWEST_BESIDE_STEP, count - FEWEST_BESIDE_STEP)
    before = at.reshape(-1, *(1,) * (x.ndim - 2)).astype(float)
    after = count - 1.0 - before
    sums, squares = (np.cumsum(part, axis=1) for part in (x, x**2))
    first, second = sums[:, at - 1], sums[:, -1:] - sums[:, at]
    rest = squares[:, at - 1] + squares[:, -1:] - squares[:, at] - first**2 / before - second**2 / after
    step = np.sum((first / before - second / after) ** 2, axis=0) / (1.0 / before + 1.0 / after)
    largest = np.max(step / np.maximum(rest.sum(axis=0), np.finfo(float).tiny), axis=0) * (count - 3.0)
    limit = np.where(used > 1, STEP_LIMIT, STEP_LIMIT_OF_ONE + STEP_LIMIT_OF_FEW / (count - 4))
    return np.asarray(largest > limit**2)


def sigma_if_steady(values: ComplexArray) -> Array:
    """Return the standard deviation (...) of the mean of windows (w, ...) by their scatter, which no step enlarges."""
    few = len(values) < FEWEST_WINDOWS
    return np.full(values.shape[1:], np.inf) if few else window_scatter(values.real) / np.sqrt(len(values))


def critical_sum(count: int, parts: NDArray[np.int64] | int) -> Array:
    """Return the limit of the cumulative sum, in units of the scatter that `count` windows of several `parts` have."""
    dof = np.asarray(DIFFERENCE_DOF * (count - 2) * parts, np.float64)
    return np.asarray(CRITICAL_SUM * stats.t.isf(FALSE_ALARM / 2.0, dof) / stats.norm.isf(FALSE_ALARM / 2.0))


def correlated_scatter(correlation: Array | float) -> Array:
    """Return the factor on the scatter of a sum over that by second differences, for a first-order Markov process."""
    r = np.asarray(correlation)
    return np.asarray(np.sqrt(3.0 * (1.0 + r) / (3.0 - r)) / (1.0 - r))


def window_scatter(series: Array) -> Array:
    """Return the scatter of windows (w, ...) that no step or drift inflates: from their least second differences.

    One at lag l has six times the variance of the series where scatter is uncorrelated over l windows. The largest over
    the lags is taken.
    """
    lags = range(1, max(1, min(LONGEST_LAG, len(series) // WINDOWS_PER_LAG)) + 1)
    means = [_trimmed_mean((series[: -2 * k] - 2.0 * series[k:-k] + series[2 * k :]) ** 2) for k in lags]
    return np.asarray(np.sqrt(np.max(means, axis=0) / 6.0))


def _trimmed_mean(squares: Array) -> Array:
    """Return the mean (...) of squares (d, ...) of normal deviates from the least ones."""
    count = max(1, int(KEPT_SHARE * len(squares)))
    return np.asarray(np.sort(squares, axis=0)[:count].mean(axis=0) / KEPT_MEAN)


def largest_change(series: Array | ComplexArray) -> Array:
    """Return the size (...) of the largest difference between the means of the windows before and after a split."""
    count = len(series)
    before = np.cumsum(series, axis=0)
    shape = (-1,) + (1,) * (series.ndim - 1)
    k = np.arange(2, count - 1)
    first = before[k - 1] / k.reshape(shape)
    second = (before[-1] - before[k - 1]) / (count - k).reshape(shape)
    return np.asarray(np.abs(first - second).max(axis=0))


def slow_change_error(values: ComplexArray, sigma: Array, dof: Array) -> Array:
    """Return the standard deviation (...) that slow changes of amplitudes (w, ...) leave in their mean.

    A tone that drifts through a harmonic is a line neither beside it nor at it. The noise of a harmonic comes from
    lines farther out, and lines that rise toward it are left out there, as those of an amplitude that follows the rotor
    speed. The mean of windows has the noise of their spectrum at rest. Sine tapers (Riedel and Sidorenko, IEEE Trans.
    Signal Process. 43, 1995, 188) weigh the whole record alike: the tone may pass at any time of it.

    `sigma` (...) is that of a real component of the mean by other lines, known by `dof` (...) complex degrees of
    freedom. It is zero where that explains the changes. A change along a straight line, as of the operating point, is
    left to other tests.
    """
    count = len(values)
    if count < FEWEST_WINDOWS:
        return np.zeros(values.shape[1:])
    tapers = _tapers(count)
    power = np.sum(np.abs(np.tensordot(tapers, values, 1)) ** 2, axis=0)
    directions = float(np.sum(tapers**2))
    variance = power / (2.0 * directions * count)
    limit = stats.f.isf(SLOW_FALSE_ALARM, 2.0 * directions, 2.0 * np.maximum(dof, 1.0))
    return np.asarray(np.where(variance > limit * sigma**2, np.sqrt(variance), 0.0))


def _tapers(count: int) -> Array:
    """Return sine tapers (k, count) without their parts along a constant and a straight line."""
    place = np.arange(1, count + 1) / (count + 1)
    tapers = np.sin(np.pi * np.outer(np.arange(1, 1 + min(count // WINDOWS_PER_TAPER + 2, MOST_TAPERS)), place))
    line = np.linalg.qr(np.stack([np.ones(count), place], axis=1))[0]
    return np.asarray((tapers - tapers @ line @ line.T) * np.sqrt(2.0 / (count + 1)))
