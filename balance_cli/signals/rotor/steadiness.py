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
from balance_cli.signals.rotor.azimuth import Azimuth
from balance_cli.signals.rotor.line_sums import unit_powers

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

TARGET_WINDOWS = 48
"""Windows of a record: enough to place a step to 2 % of the record, few enough that each holds several revolutions."""
FEWEST_WINDOWS = 8
"""With fewer windows the test has no power; nothing is concluded."""
LONGEST_LAG = 4
"""Windows over which scatter may be correlated (gusts) without being taken for a step."""
CRITICAL_SUM = 2.6
"""Largest cumulative sum, in units of its scatter, that a steady amplitude reaches once in 4e5 tests.

For the Brownian bridge P(sup |B| > x) = 2 exp(-2 x^2) (Kolmogorov). The level leaves room for records with hundreds of
harmonics, components and runs.
"""
LEAST_EIGENVALUE = 1e-8
"""Of the normal equations of a window, over the largest: they then leave eight digits, else least squares by singular
values are taken."""
MATERIAL_CHANGE = 3.0
"""Change within the record, in stated standard deviations of the mean amplitude, that makes a flag worthwhile.

A smaller change is covered by the uncertainty that the load carries anyway.
"""


@dataclass(frozen=True)
class WindowedAmplitudes:
    """Amplitudes (w, n+1, c) of harmonics 0 to n of c channels in w consecutive windows of whole revolutions.

    `speed` (w,) [Hz] is the mean rotor speed of each window.
    """

    values: ComplexArray
    names: tuple[str, ...]
    speed: Array


def windowed_amplitudes(
    run: Run, azimuth: Azimuth, names: Sequence[str], n: int, revolutions: tuple[int, int]
) -> WindowedAmplitudes:
    """Regress harmonics 0 to `n` of the named channels on azimuth, window by window, from one revolution to another."""
    first, last = revolutions
    length = max(1, -(-(last - first) // TARGET_WINDOWS))
    edges = np.arange(first, last + 1, length)
    assert run.sample_rate is not None
    times = azimuth.time_of(edges)
    samples = np.ceil(times * run.sample_rate).astype(int)
    time = np.clip(np.arange(samples[0], samples[-1]) / run.sample_rate, azimuth.first, azimuth.last)
    powers = unit_powers(azimuth.psi(time), max(n, 1))[: n + 1]
    basis, signals = np.concatenate([powers.real, powers[1:].imag]), read_channels(run, names, samples[0], samples[-1])
    cuts = [slice(a, b) for a, b in pairwise((samples - samples[0]).tolist())]
    empty = np.zeros((0, n + 1, len(names)), complex)
    values = _amplitudes([basis[:, cut] for cut in cuts], [signals[cut] for cut in cuts], n) if cuts else empty
    return WindowedAmplitudes(values, tuple(names), length / np.diff(times))


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


def unsteady(values: ComplexArray, sigma: Array) -> NDArray[np.bool_]:
    """Which series of amplitudes (w, ...) step or drift by more than chance and by more than `sigma` (...) covers.

    `sigma` is the stated standard deviation of the mean over all windows, of one real component.
    """
    count = len(values)
    if count < FEWEST_WINDOWS:
        return np.zeros(values.shape[1:], bool)
    parts = np.stack([values.real, values.imag])
    wander = np.cumsum(parts - parts.mean(axis=1, keepdims=True), axis=1)
    largest = np.abs(wander).max(axis=1)
    scatter = np.stack([_scatter(part) for part in parts])
    with np.errstate(divide="ignore", invalid="ignore"):
        excess = np.where(largest > 0, largest / (scatter * np.sqrt(count)), 0.0)
    change = np.stack([_largest_change(part) for part in parts])
    return np.asarray(np.any((excess > CRITICAL_SUM) & (change > MATERIAL_CHANGE * sigma), axis=0))


def _scatter(series: Array) -> Array:
    """Return the scatter of windows (w, ...) that a step does not inflate: from the median of squared differences.

    A difference at lag l has twice the variance of the series where scatter is uncorrelated over l windows. The
    largest over the lags is taken. 0.4549 is the median of chi-square with one degree of freedom.
    """
    lags = range(1, min(LONGEST_LAG, len(series) // 4) + 1)
    medians = [np.median((series[lag:] - series[:-lag]) ** 2, axis=0) for lag in lags]
    return np.asarray(np.sqrt(np.max(medians, axis=0) / (2.0 * 0.4549)))


def _largest_change(series: Array) -> Array:
    """Return the largest difference (...) between the mean of the windows before a split and that of those after it."""
    count = len(series)
    before = np.cumsum(series, axis=0)
    shape = (-1,) + (1,) * (series.ndim - 1)
    k = np.arange(2, count - 1)
    first = before[k - 1] / k.reshape(shape)
    second = (before[-1] - before[k - 1]) / (count - k).reshape(shape)
    return np.asarray(np.abs(first - second).max(axis=0))
