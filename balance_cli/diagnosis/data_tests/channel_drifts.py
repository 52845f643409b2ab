"""What drifts within a record: each channel against all others, where periods do not tell the channels of a cell.

The second half of the steady periods of a channel, over the first half, is one but for a gain and a delay that drift:

    Y_last / Y_first = 1 + g - j w tau

Of a record that does not repeat its local models tell both (`signals.local.record_drift`), of all channels.

A change y of channel c in record r is that of the exciter, which all channels share, and that of the channel:

    y_rc = a_r + v_c + noise,        v = N^+ b,    N = sum_r diag(w_r) - w_r w_r' / sum(w_r),    chi2 = b' v

with the weights w_r, and b the weighted sum of y_r about the weighted means. Where channels differ, they are divided
into two groups of like values: a box of channels on a clock of its own is one group, which is late together, and an
amplifier that warms up is a group of one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.data_test_settings import DataTestSettings
from balance_cli.diagnosis.data_tests.record_changes import noise_of_period
from balance_cli.diagnosis.result import RECORD_CHANGE_TEST, ModelFreeTest
from balance_cli.diagnosis.significance import bonferroni_min_p_value, chi2_p_value, format_with_sigma
from balance_cli.signals.run_spectrum import RecordDrift, RunSpectrum

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

GAIN, DELAY = 0, 1
SINGLE_CHANNELS, EVERY_CHANNEL = "channels of cells with one channel", "all channels, in records that do not repeat"
"""Places of a test that finds nothing."""


def channel_drift_tests(
    runs: Sequence[RunSpectrum], geometry: Geometry, settings: DataTestSettings
) -> list[ModelFreeTest]:
    """One row where periodic records have channels of cells with one channel, one where records do not repeat."""
    of_cells = [channel for channel in geometry.channels if channel.cell is not None]
    cells = Counter(channel.cell for channel in of_cells)
    periodic = [run for run in runs if run.periods is not None]
    single = _shared_channels(periodic, [item.name for item in of_cells if cells[item.cell] == 1])
    others = [run for run in runs if run.drift is not None]
    every = _shared_channels(others, [item.name for item in of_cells])
    parts = (
        (SINGLE_CHANNELS, single, [_drift_between_periods(run, single, settings) for run in periodic if single]),
        (EVERY_CHANNEL, every, [_drift_of_channels(run, every) for run in others]),
    )
    rows = [_test(place, names, [drift for drift in drifts if drift], settings) for place, names, drifts in parts]
    return [row for row in rows if row is not None]


def _shared_channels(runs: Sequence[RunSpectrum], names: Sequence[str]) -> tuple[str, ...]:
    """Those of the channels that all runs have."""
    return tuple(name for name in names if runs and all(name in run.channel_names for run in runs))


def _drift_of_channels(run: RunSpectrum, names: Sequence[str]) -> RecordDrift:
    """The drift of some channels of a record that does not repeat."""
    assert run.drift is not None
    places = [run.channel_names.index(name) for name in names]
    change, covariance = run.drift.change[:, places], run.drift.covariance[:, places][:, :, places]
    return RecordDrift(change, covariance, run.drift.signal_to_noise[places], run.drift.dof)


def _drift_between_periods(run: RunSpectrum, names: Sequence[str], settings: DataTestSettings) -> RecordDrift | None:
    """The drift of some channels of a periodic record; None for a record that is too short."""
    assert run.periods is not None
    steady = _first_steady_periods(run)
    begin = min(int(steady.max()), len(run.periods) - 2 * settings.record_changes.min_half_periods)
    lines = np.flatnonzero((run.frequency > 0) & (steady <= begin))
    if begin < 1 or not lines.size:
        return None
    places = [run.channel_names.index(name) for name in names]
    periods = run.periods[begin:, lines[:, None], places]
    half = len(periods) // 2
    covariance, dof = noise_of_period(periods)
    variance = np.diagonal(covariance, axis1=1, axis2=2).real
    first, last = periods[:half].mean(axis=0), periods[-half:].mean(axis=0)
    value, sigma = _fit_gain_and_delay(first, last, variance / half, 2.0 * np.pi * run.frequency[lines])
    signal = np.sum(np.abs(first) ** 2, axis=0) / np.sum(variance / half, axis=0)
    return RecordDrift(value, np.array([np.diag(each**2) for each in sigma]), signal, dof)


def _first_steady_periods(run: RunSpectrum) -> NDArray[np.intp]:
    """The first period (k,) in which a line holds no start transient, at least the second of the record."""
    assert run.periods is not None
    if run.window is None:
        return np.ones(len(run.frequency), np.intp)
    # A record that begins with part of a period passes for one of longer periods, whose first steady one is no earlier.
    first = np.ceil(len(run.periods) * run.window.start / run.window.stop - 1e-9)
    return np.maximum(first.astype(np.intp), 1)


def _fit_gain_and_delay(first: ComplexArray, last: ComplexArray, variance: Array, omega: Array) -> tuple[Array, Array]:
    """Gain and delay (2, c) that turn the first half into the last, and their sigmas (2, c).

    What they do not describe widens sigma (Birge ratio): a transient that remains is neither.
    """
    weight = np.abs(first) ** 2 / (2.0 * variance)  # inverse variance of each part of the ratio's change, times two
    change = last / np.where(first == 0, 1.0, first) - 1.0
    size = np.stack([weight.sum(axis=0), (weight * omega[:, None] ** 2).sum(axis=0)])
    size = np.maximum(size, np.finfo(float).tiny)
    gain = np.sum(weight * change.real, axis=0) / size[GAIN]
    delay = -np.sum(weight * omega[:, None] * change.imag, axis=0) / size[DELAY]
    left = change - gain + 1j * omega[:, None] * delay
    birge = 2.0 * np.sum(weight * np.abs(left) ** 2, axis=0) / max(2 * len(omega) - 2, 1)
    return np.stack([gain, delay]), np.sqrt(np.maximum(birge, 1.0) / (2.0 * size))


def _test(
    unchanged: str, names: Sequence[str], drifts: Sequence[RecordDrift], settings: DataTestSettings
) -> ModelFreeTest | None:
    """Whether the changes of the channels over all records differ, in gain or in delay; `unchanged`: the place if not.

    None of too few channels that carry a signal.
    """
    least = settings.run_changes.min_signal_to_noise
    carries = np.array([drift.signal_to_noise >= least for drift in drifts]).reshape(len(drifts), len(names))
    loaded = np.flatnonzero(carries.any(axis=0))
    if len(loaded) < settings.record_changes.min_channels:
        return None
    value = np.array([drift.change[:, loaded] for drift in drifts])
    is_known = carries[:, None, loaded]
    covariance = np.array([drift.covariance[:, loaded][:, :, loaded] for drift in drifts])
    covariance = np.where(is_known[..., None] & is_known[..., None, :], covariance, 0.0)
    weight = is_known / np.where(is_known, np.diagonal(covariance, axis1=2, axis2=3), 1.0)
    fits = [ChannelFit.of(value[:, kind], weight[:, kind]) for kind in (GAIN, DELAY)]
    limit = min(drift.dof for drift in drifts)
    p_values = [fit.p_value(weight[:, kind], covariance[:, kind], limit) for kind, fit in enumerate(fits)]
    kind, p_value = int(np.argmin(p_values)), bonferroni_min_p_value(p_values)
    place, finding = unchanged, "equal"
    if p_value <= settings.significance_level:
        group = fits[kind].deviating_group(settings.record_changes.clear_sigma)
        place = ", ".join(names[loaded[i]] for i in group)
        finding = _describe(kind, *fits[kind].change_of(group), len(group))
    return ModelFreeTest(RECORD_CHANGE_TEST, place, fits[kind].chi2, len(loaded) - 1.0, p_value, finding)


@dataclass(frozen=True)
class ChannelFit:
    """Changes of channels relative to each other: N `matrix` (c, c), b `right` (c,), and weighted means `mean` (c,)."""

    matrix: Array
    right: Array
    mean: Array

    @classmethod
    def of(cls, value: Array, weight: Array) -> ChannelFit:
        """The fit of changes (r, c) with weights (r, c)."""
        total = np.maximum(weight.sum(axis=1, keepdims=True), np.finfo(float).tiny)
        matrix = np.diag(weight.sum(axis=0)) - weight.T @ (weight / total)
        about = value - np.sum(weight * value, axis=1, keepdims=True) / total
        return cls(matrix, np.sum(weight * about, axis=0), np.sum(weight * value, axis=0) / weight.sum(axis=0))

    @property
    def change(self) -> Array:
        """V (c,), of any common level."""
        return np.asarray(np.linalg.pinv(self.matrix, hermitian=True) @ self.right)

    @property
    def chi2(self) -> float:
        """Chi-square of channels that do not differ."""
        return float(self.right @ self.change)

    def p_value(self, weight: Array, covariance: Array, noise_dof: float) -> float:
        """P-value of channels that do not differ, for changes with weights (r, c) and covariance (r, c, c).

        Noise that channels have in common, of a floor that shakes, is in few directions: with the covariance S of b the
        mean of chi-square is tr N^+ S, and its variance 2 tr (N^+ S)^2 (Satterthwaite).
        """
        total = np.maximum(weight.sum(axis=1), np.finfo(float).tiny)[:, None, None]
        centered = weight[:, :, None] * np.eye(len(self.right)) - weight[:, :, None] * weight[:, None, :] / total
        scatter = np.sum(centered @ covariance @ centered, axis=0)
        relative = np.linalg.pinv(self.matrix, hermitian=True) @ scatter
        mean, half_variance = float(np.trace(relative)), float(np.sum(relative * relative.T))
        return chi2_p_value(self.chi2 * mean / half_variance, (mean**2 / half_variance,), (noise_dof,))

    def change_of(self, group: Sequence[int] | NDArray[np.intp]) -> tuple[float, float]:
        """The change of a group against all others, and its sigma."""
        members = np.isin(np.arange(len(self.right)), group).astype(float)
        information = float(members @ self.matrix @ members)
        return float(members @ self.right) / information, information**-0.5

    def deviating_group(self, clear_sigma: float) -> list[int]:
        """The smaller of the two groups that explain most of chi-square; of equal ones that which has changed more."""
        order = np.argsort(self.change)
        groups = [(order[:i], order[i:]) for i in range(1, len(order))]
        parts = max(groups, key=lambda each: abs(self.change_of(each[0])[0] / self.change_of(each[0])[1]))
        small, large = sorted(parts, key=lambda part: (len(part), -abs(float(np.mean(self.mean[part])))))
        departure = np.abs(self.change - np.mean(self.change[large])) * np.sqrt(np.diag(self.matrix))
        return sorted(int(i) for i in small if departure[i] > clear_sigma) or sorted(map(int, small))


def _describe(kind: int, change: float, sigma: float, count: int) -> str:
    """How far a group of `count` channels has moved against the others, in words."""
    opening = "drifts within the records: against the first half and the other channels, in the last it "
    if kind == GAIN:
        return opening + f"reads {format_with_sigma(1.0 + change, sigma)} times as much"
    late = "late" if change > 0 else "early"
    cause = "; one cause for all of them would be a clock of their own" if count > 1 else ""
    return opening + f"is {late} by {format_with_sigma(1e3 * abs(change), 1e3 * sigma, 'ms')}{cause}"
