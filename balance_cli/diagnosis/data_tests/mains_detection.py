"""Mains interference: whether lines at the mains frequency and its multiples exceed their neighbors.

In a window around a line a local rational model (see `signals.local.fit`) is fitted to all lines except those within
one of the middle, and the departures of the excluded lines from it are measured. The same is done around neighboring
lines, where there is no mains. The ratio of the two is about one, even where the local model is inaccurate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from balance_cli.diagnosis.data_test_settings import DataTestSettings, MainsDetectionSettings
from balance_cli.diagnosis.result import ModelFreeTest
from balance_cli.diagnosis.significance import bonferroni_min_p_value, fisher_p_values, variance_ratio_p_values
from balance_cli.signals.local.fit import LocalFit, ModelOrders, WindowedData, fit_windows
from balance_cli.signals.run_spectrum import RunSpectrum

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

MAINS_TEST_NAME = "mains"
MAINS = (50.0, 60.0)


@dataclass(frozen=True)
class _Departures:
    """Departures of the lines of one run from their local models, at multiples (w,) [Hz] of the mains frequency.

    `power` (w, c) [V2] of `count` (w, c) real values; `neighbor_power` (w, c) per real value, from `neighbor_count`
    (w, c) real values.
    """

    channels: tuple[str, ...]
    multiple: Array
    power: Array
    count: Array
    neighbor_power: Array
    neighbor_count: Array


def mains_tests(runs: Sequence[RunSpectrum], settings: DataTestSettings) -> list[ModelFreeTest]:
    """One row for 50 Hz and one for 60 Hz, if any run has lines there."""
    rows = []
    for mains in MAINS:
        by_run = (_departures(run, mains, settings.mains) for run in runs)
        departures = [departure for departure in by_run if departure is not None]
        if any(departure.count.any() for departure in departures):
            rows.append(_test(mains, departures, settings))
    return rows


def _departures(run: RunSpectrum, mains: float, settings: MainsDetectionSettings) -> _Departures | None:
    half_window, offsets = settings.half_window, np.array(settings.neighbor_offsets)
    moving = np.flatnonzero(run.frequency > 0)
    frequency = run.frequency[moving]
    if len(frequency) < 2 * half_window + 1:
        return None
    bin_width = float(np.min(np.diff(frequency)))
    multiples = np.arange(mains, frequency[-1] + bin_width, mains)
    middles = [
        (multiple, int(np.argmin(np.abs(frequency - multiple))))
        for multiple in multiples
        if np.min(np.abs(frequency - multiple)) <= settings.excluded_bins * bin_width
        and not _is_rotor_harmonic(run, multiple, settings.rotor_harmonic_bins * bin_width)
    ]
    middles = [(f, k) for f, k in middles if half_window <= k < len(frequency) - half_window]
    if not middles:
        return None
    all_middles = np.concatenate([[k, *(k + offsets)] for _, k in middles])
    all_middles = np.clip(all_middles, half_window, len(frequency) - half_window - 1)
    near = np.min(np.abs(frequency[:, None] - multiples), axis=1) <= settings.excluded_bins * bin_width
    power, count, noise = _excluded_line_power(run, moving, all_middles, near, settings)
    shape = (len(middles), 1 + len(offsets), -1)
    power, count, noise = power.reshape(shape), count.reshape(shape), noise.reshape(shape)
    # A neighboring window that was clipped onto the lines of the mains carries no information.
    centers = all_middles.reshape(shape[:2])
    is_separate = np.abs(centers[:, 1:] - centers[:, :1]) > 2
    neighbor_count = np.sum(count[:, 1:] * is_separate[:, :, None], axis=1)
    neighbor_power = np.sum(power[:, 1:] * is_separate[:, :, None], axis=1) / np.maximum(neighbor_count, 1.0)
    multiple = np.array([f for f, _ in middles])
    return _Departures(
        run.channel_names, multiple, power[:, 0], count[:, 0], np.maximum(neighbor_power, noise[:, 0]), neighbor_count
    )


def _is_rotor_harmonic(run: RunSpectrum, frequency: float, distance: float) -> bool:
    """Whether a harmonic of the turning rotor lies within a distance of a frequency."""
    if run.rotor_speed <= 0:
        return False
    away = abs(frequency - run.rotor_speed * round(frequency / run.rotor_speed))
    return bool(away < distance)


def _excluded_line_power(
    run: RunSpectrum, moving: Index, middles: Index, near: NDArray[np.bool_], settings: MainsDetectionSettings
) -> tuple[Array, Array, Array]:
    """Power (w, c) of the departures of the excluded lines of each window, their real values (w, c), and noise (w, c).

    The noise is the power per real value. Lines at the mains are excluded from every fit and do not count in the
    neighbors. A window that no local model describes has no real values.
    """
    c, offsets = len(run.channel_names), np.arange(-settings.half_window, settings.half_window + 1)
    at = middles[:, None] + offsets
    lines = moving[at]
    variance = np.median(_noise_variance(run)[lines], axis=1)
    Y = run.channels[lines] / np.sqrt(variance)[:, None, :]
    # Loads of a window are scaled to one, so that a small one is not lost in rounding.
    U = run.loads[lines] / np.maximum(np.abs(run.loads[lines]).max(axis=(1, 2)), np.finfo(float).tiny)[:, None, None]
    frequency = run.frequency[lines]
    ends = frequency[:, :1], frequency[:, -1:]
    r = (2.0 * frequency - ends[0] - ends[1]) / (ends[1] - ends[0])
    beside = np.abs(offsets) <= 1
    here = near[at]
    windows = WindowedData(Y, U, np.where(beside | here, 0.0, 1.0), r)
    modeled, followed = _simplest_local_model(windows, settings)
    away = _remove_response_shapes(Y - modeled, Y * windows.weight[:, :, None], settings.shapes)
    counted = np.where(here[:, settings.half_window, None], here, beside & ~here) & beside
    power = np.sum(np.where(counted[:, :, None], np.abs(away) ** 2, 0.0), axis=1) * variance
    count = np.where(followed, 2.0 * counted.sum(axis=1), 0.0)[:, None] * np.ones(c)
    return np.where(count > 0, power, 0.0), count, 0.5 * variance


def _noise_variance(run: RunSpectrum) -> Array:
    """Variance (k, c) of the channels about their response to the measured loads."""
    c = len(run.channel_names)
    variance = np.diagonal(run.covariance, axis1=1, axis2=2).real
    power = np.maximum(np.sum(np.abs(run.loads) ** 2, axis=1), np.finfo(float).tiny)
    loads = np.sum(variance[:, c:], axis=1) / power
    return np.asarray(variance[:, :c] + np.abs(run.channels) ** 2 * loads[:, None])


def _has_hidden_peak(fit: LocalFit, settings: MainsDetectionSettings) -> NDArray[np.bool_]:
    """Whether a window (w,) has a sharp peak near its middle, hidden by the excluded lines."""
    near = np.zeros(len(fit.denominator), bool)
    for i, a in enumerate(fit.denominator):
        poles = settings.half_window * legendre.legroots(a)
        hidden = np.maximum(np.abs(poles.real), np.abs(poles.imag)) < settings.hidden_peak_lines
        near[i] = bool(np.any(hidden))
    return near


def _simplest_local_model(
    windows: WindowedData, settings: MainsDetectionSettings
) -> tuple[ComplexArray, NDArray[np.bool_]]:
    """The lines (w, M, c) by the simplest local model that describes a window, and whether (w,) any does."""
    c, u = windows.Y.shape[2], windows.U.shape[2]
    modeled = np.zeros_like(windows.Y)
    followed = np.zeros(len(windows.Y), bool)
    for denominator in settings.denominator_orders:
        orders = ModelOrders(response=settings.response_order, transient=-1, denominator=denominator)
        remaining = np.flatnonzero(~followed)
        if not remaining.size:
            break
        subset = windows.subset(remaining)
        fit = fit_windows(subset, orders)
        free = subset.weight.sum(axis=1) - orders.coefficients(u) - orders.denominator / c
        good = (fit.cost / c < settings.max_window_chi2 * np.maximum(free, 0.0)) & ~_has_hidden_peak(fit, settings)
        accepted = np.flatnonzero(good)
        modeled[remaining[good]] = _predict_windows(subset.subset(accepted), fit.subset(accepted))
        followed[remaining[good]] = True
    return modeled, followed


def _predict_windows(windows: WindowedData, fit: LocalFit) -> ComplexArray:
    """All lines (w, M, c) of the windows by their local models, including those without weight."""
    orders = fit.orders
    P = legendre.legvander(windows.r, max(orders.response, orders.denominator))
    driven = windows.U[:, :, :, None] * P[:, :, None, : orders.response + 1]
    A = np.matmul(P[:, :, : orders.denominator + 1], fit.denominator[:, :, None])
    w, M, inputs, powers = driven.shape
    return np.asarray(driven.reshape(w, M, inputs * powers) @ fit.coefficients / A)


def _remove_response_shapes(away: ComplexArray, Y: ComplexArray, max_shapes: int) -> ComplexArray:
    """The departures (w, M, c) without the response shapes of the channels Y (w, M, c) in the fitted lines.

    A sharp peak that the local model misses is such a shape; interference in one channel is not.
    """
    shapes = min(max_shapes, max(Y.shape[2] - 2, 0))
    V = np.linalg.svd(Y, full_matrices=False)[2][:, :shapes]
    return np.asarray(away - (away @ V.conj().swapaxes(1, 2)) @ V)


def _test(mains: float, departures: Sequence[_Departures], settings: DataTestSettings) -> ModelFreeTest:
    """Power at the mains over that of the neighbors, by multiple and channel, over all runs."""
    channels = tuple(dict.fromkeys(name for departure in departures for name in departure.channels))
    multiples = np.unique(np.concatenate([departure.multiple for departure in departures]))
    sums = _MainsSums.zeros(len(multiples), len(channels))
    for departure in departures:
        places = np.array([channels.index(name) for name in departure.channels])
        sums.add(departure, np.ix_(np.searchsorted(multiples, departure.multiple), places), settings.mains)
    p_values = sums.fisher_p_values()
    p_value = bonferroni_min_p_value(p_values[sums.runs > 0])
    finding = "nothing"
    if p_value <= settings.significance_level:
        clear = [
            (int(i), int(j)) for i, j in np.argwhere(p_values * np.sum(sums.runs > 0) <= settings.significance_level)
        ]
        amplitude = np.sqrt(sums.excess_power / np.maximum(sums.runs, 1.0))
        finding = _finding(sorted(clear, key=lambda at: p_values[at]), channels, multiples, amplitude)
    place = f"{mains:g} Hz and multiples"
    return ModelFreeTest(MAINS_TEST_NAME, place, float(sums.chi2.sum()), float(sums.count.sum()), p_value, finding)


@dataclass
class _MainsSums:
    """Sums over the runs, by multiple and channel: chi-square with its dof, and power above the neighbors' [V2].

    `fisher`: sum of -2 ln of the runs' p-values; `runs`: their number.
    """

    chi2: Array
    count: Array
    fisher: Array
    runs: Array
    excess_power: Array

    @classmethod
    def zeros(cls, multiples: int, channels: int) -> _MainsSums:
        """The sums of no run."""
        return cls(*(np.zeros((multiples, channels)) for _ in range(5)))

    def add(self, departure: _Departures, at: tuple[Index, ...], settings: MainsDetectionSettings) -> None:
        """Add a run."""
        n, d = departure.count, departure.neighbor_count
        informed = (d > settings.min_neighbor_count) & (n > 0)
        ratio = departure.power / departure.neighbor_power
        p_values = np.maximum(variance_ratio_p_values(ratio, n, d), settings.min_run_p_value)
        self.chi2[at] += np.where(informed, ratio * (d - 2.0) / np.maximum(d, 1.0), 0.0)
        self.count[at] += np.where(informed, n, 0.0)
        self.fisher[at] += np.where(informed, -2.0 * np.log(p_values), 0.0)
        self.runs[at] += informed
        excess = np.maximum(departure.power - n * departure.neighbor_power, 0.0)
        self.excess_power[at] += np.where(informed, excess, 0.0)

    def fisher_p_values(self) -> Array:
        """P-value of each multiple and channel, all runs combined by Fisher's method."""
        return fisher_p_values(self.fisher, self.runs)


def _finding(clear: Sequence[tuple[int, int]], channels: Sequence[str], multiples: Array, amplitude: Array) -> str:
    parts = [
        f"{channels[j]} at {multiples[i]:g} Hz, about {1e3 * amplitude[i, j]:.2g} mV above its neighbors"
        for i, j in clear[:3]
    ]
    more = f", and {len(clear) - 3} more" if len(clear) > 3 else ""
    return "stands out: " + "; ".join(parts) + more
