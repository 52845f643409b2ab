"""Zeros of channels, and their drift from run to run: everyday for bridges, and of no use to an identification.

The mean of a swept record is that of its loads through the static response, and the channel's zero:

    y_rc = sum_j T_cj (u_rj - o_j) + z_c + e_rc

with a zero z_c and a load offset o_j that are the same in all runs. Where the e of a channel scatter more than their
noise, its zero drifts. Its variance then belongs to the means, so that no effect explains what is none. The
quadratic force of a cell shifts means, too, but in proportion to the power of its motion, and in the channels of the
whole plate: where one such cell describes most of what is left, it is left to the search.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.diagnosis.data_test_settings import DataTestSettings
from balance_cli.diagnosis.result import EXPLAINED, NOTHING_MISSING, PARTLY_EXPLAINED, Diagnosis, ModelFreeTest
from balance_cli.diagnosis.significance import bonferroni_p_value, chi2_p_value
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.model.system import System
from balance_cli.model.system_response import Solution, response, solve, volts_of_forces
from balance_cli.signals.run_spectrum import RunSpectrum

Array = NDArray[np.float64]

ZERO_DRIFT_TEST = "zeros, run against run"


@dataclass(frozen=True)
class ZeroDrift:
    """Channels whose zeros drift, and the standard deviation of these from run to run [V].

    `static_sigma`: of one static reading of each channel [V], infinite without any; chi-square of all drifting
    channels, its degrees of freedom and its p-value, corrected for the number of channels.
    """

    channels: tuple[str, ...]
    sigma: Array
    static_sigma: Array
    chi2: float
    dof: float
    p_value: float

    @property
    def matters(self) -> bool:
        """Whether a zero drifts by more than a reading of a calibration scatters, so that it is what limits means."""
        return bool(np.any(self.sigma > self.static_sigma))

    @property
    def test(self) -> ModelFreeTest:
        """The row of the data tests."""
        places = ", ".join(self.channels)
        return ModelFreeTest(ZERO_DRIFT_TEST, places, self.chi2, self.dof, self.p_value, f"the zeros {self._sizes}")

    @property
    def note(self) -> str:
        """One sentence, with what follows for the loads."""
        text = f"zeros, which no harmonic load depends on, {self._sizes}"
        if self.matters:
            return f"{text}: a mean load is off by what they drift after its zero record; record zeros before and after"
        return f"{text}, less than a static reading scatters"

    @property
    def _sizes(self) -> str:
        sizes = ", ".join(f"{name} {size:.2g} V" for name, size in zip(self.channels, self.sigma, strict=True))
        return f"drift from run to run (rms): {sizes}"


@dataclass(frozen=True)
class _Means:
    """Means of R runs in C channels [V] and their variance (NaN and infinite where there is none), and loads (R, 6).

    `applied` (R, 6): which loads were applied; `power` (R, C) of the channels about their means; `noise_dof` of the
    noise that is known least.
    """

    volts: Array
    variance: Array
    loads: Array
    applied: NDArray[np.bool_]
    power: Array
    noise_dof: float


@dataclass(frozen=True)
class Zeros:
    """What the means of sweeps tell of the zeros of channels: those that differ from none [V], and their drift."""

    offsets: dict[str, float]
    drift: ZeroDrift | None


def find_zeros(system: System, spectra: Spectra, settings: DataTestSettings) -> Zeros:
    """Return the zeros of channels and their drift; nothing where a cell's own force may be what shifts the means."""
    names, limits = system.channel_names, settings.zero_drift
    means = _means(spectra.lines, names)
    tested = np.isfinite(means.variance).sum(axis=0) >= limits.min_runs
    if system.equations.nonlinear_terms or tested.sum() < limits.min_channels:
        return Zeros({}, None)
    at_rest = solve(system, np.zeros(1))
    T = response(system, at_rest)[0].real
    variance = means.variance + (limits.response_error * np.abs(means.loads) @ np.abs(T).T) ** 2
    variance[:, ~tested] = np.inf
    columns = _shared_columns(T, means, tested)
    regression = _MeanRegression.of(columns, means.volts - means.loads @ T.T, variance)
    patterns = list(_cell_patterns(system, means, at_rest))
    drift = None
    if regression.largest_share(patterns) <= limits.cell_share:
        drift = _drift(regression, _static_sigma(spectra, names), names, means.noise_dof, settings)
    if drift is not None:
        variance[:, [names.index(name) for name in drift.channels]] += drift.sigma**2
        regression = _MeanRegression.of(columns, means.volts - means.loads @ T.T, variance)
    without = _MeanRegression.of(columns[:0], means.volts - means.loads @ T.T, variance)
    is_clear = without.largest_share(patterns) <= limits.cell_share
    return Zeros(_clear_offsets(regression, tested, names, settings) if is_clear else {}, drift)


def _drift(
    regression: _MeanRegression, static_sigma: Array, names: Sequence[str], noise_dof: float, settings: DataTestSettings
) -> ZeroDrift | None:
    chi2, dof = regression.channel_chi2, regression.used.sum(axis=0) - 1.0
    tested = int(np.sum(dof > 0))
    p_values = np.array([chi2_p_value(q, (n,), (noise_dof,)) if n > 0 else 1.0 for q, n in zip(chi2, dof, strict=True)])
    drifts = np.flatnonzero(p_values * tested <= settings.significance_level)
    if not len(drifts):
        return None
    return ZeroDrift(
        channels=tuple(names[int(i)] for i in drifts),
        sigma=np.sqrt(_moment_variance(chi2[drifts], dof[drifts], 1.0 / regression.variance[:, drifts])),
        static_sigma=static_sigma[drifts],
        chi2=float(chi2[drifts].sum()),
        dof=float(dof[drifts].sum()),
        p_value=min(1.0, float(p_values[drifts].min() * tested)),
    )


def _clear_offsets(
    regression: _MeanRegression, tested: NDArray[np.bool_], names: Sequence[str], settings: DataTestSettings
) -> dict[str, float]:
    """The zeros of the channels tested that are significant; the first columns of the regression are theirs."""
    channels = [names[int(i)] for i in np.flatnonzero(tested)]
    z2 = (regression.values / regression.sigma) ** 2
    return {
        name: float(regression.values[i])
        for i, name in enumerate(channels)
        if bonferroni_p_value(float(z2[i]), 1, len(channels)) <= settings.significance_level
    }


def add_drift_variance(spectra: Spectra, drift: ZeroDrift | None) -> Spectra:
    """Return the spectra with the variance of drifting zeros in the means of their sweeps."""
    if drift is None:
        return spectra
    return replace(spectra, lines=tuple(_with_drift(run, drift) for run in spectra.lines))


def judge_zero_drift(diagnosis: Diagnosis, drift: ZeroDrift | None) -> Diagnosis:
    """Return the diagnosis with the zeros that drift: they matter where a static reading scatters less."""
    if drift is None:
        return diagnosis
    verdict = diagnosis.verdict
    if drift.matters and verdict in (NOTHING_MISSING, EXPLAINED):
        verdict = PARTLY_EXPLAINED
    tests, notes = (*diagnosis.data_tests, drift.test), (*diagnosis.notes, drift.note)
    return replace(diagnosis, data_tests=tests, notes=notes, verdict=verdict)


# ---- means and their residual ----------------------------------------------------------------------------------------


def _means(runs: Sequence[RunSpectrum], names: Sequence[str]) -> _Means:
    with_mean = [run for run in runs if (run.frequency == 0).any()]
    shape = (len(with_mean), len(names))
    volts, variance, power = np.zeros(shape), np.full(shape, np.inf), np.zeros(shape)
    loads = np.zeros((len(with_mean), len(COMPONENTS)))
    applied = np.zeros(loads.shape, bool)
    for r, run in enumerate(with_mean):
        line = int(np.flatnonzero(run.frequency == 0)[-1])
        channels = [names.index(name) for name in run.channel_names]
        components = [COMPONENTS.index(name) for name in run.components]
        # A line at frequency zero is twice the mean.
        volts[r, channels] = 0.5 * run.channels[line].real
        variance[r, channels] = 0.25 * np.diag(run.covariance[line]).real[: len(channels)]
        power[r, channels] = 0.5 * np.sum(np.abs(run.channels[run.frequency > 0]) ** 2, axis=0)
        loads[r, components] = 0.5 * run.loads[line].real
        applied[r, components] = True
    noise_dof = min((2.0 * max(run.dof, 1.0) for run in with_mean), default=np.inf)
    return _Means(volts, variance, loads, applied, power, noise_dof)


def _shared_columns(T: Array, means: _Means, tested: NDArray[np.bool_]) -> Array:
    """What all runs share (p, R, C): a zero of each channel tested, and an offset of each load that was applied."""
    shape = means.volts.shape
    channels = [np.broadcast_to(np.eye(shape[1])[i], shape) for i in np.flatnonzero(tested)]
    loads = [np.outer(means.applied[:, j], T[:, j]) for j in np.flatnonzero(means.applied.any(axis=0))]
    return np.stack([*channels, *loads])


@dataclass(frozen=True)
class _MeanRegression:
    """Weighted least squares of means on columns: values and sigma (p,), residual (n,) over its sigma where `used`.

    `variance` and `used` (R, C); `basis` (n, q) spans the weighted columns.
    """

    values: Array
    sigma: Array
    residual: Array
    basis: Array
    variance: Array

    @classmethod
    def of(cls, columns: Array, volts: Array, variance: Array) -> _MeanRegression:
        """The regression of volts (R, C) of a variance (infinite: not used) on columns (p, R, C)."""
        used = np.isfinite(variance)
        weight = 1.0 / np.sqrt(variance[used])
        A, y = columns[:, used].T * weight[:, None], volts[used] * weight
        left, size, right = np.linalg.svd(A, full_matrices=False)
        kept = size > np.finfo(float).eps * len(y) * size.max(initial=0.0)
        left, size, right = left[:, kept], size[kept], right[kept]
        values = right.T @ ((left.T @ y) / size)
        sigma = np.sqrt(np.sum((right / size[:, None]) ** 2, axis=0))
        return cls(values, sigma, y - left @ (left.T @ y), left, variance)

    @property
    def used(self) -> NDArray[np.bool_]:
        """Which means take part (R, C)."""
        return np.isfinite(self.variance)

    @property
    def channel_chi2(self) -> Array:
        """Chi-square (C,) of each channel."""
        squares = np.zeros(self.variance.shape)
        squares[self.used] = self.residual**2
        return np.asarray(squares.sum(axis=0), float)

    def largest_share(self, patterns: Sequence[Array]) -> float:
        """The largest share of the squared residual that one pattern (R, C) describes."""
        shares = [0.0]
        for pattern in patterns:
            column = pattern[self.used] / np.sqrt(self.variance[self.used])
            column = column - self.basis @ (self.basis.T @ column)
            size = float(column @ column)
            if size > 0.0:
                shares.append(float(column @ self.residual) ** 2 / size)
        return max(shares) / max(float(self.residual @ self.residual), np.finfo(float).tiny)


def _cell_patterns(system: System, means: _Means, at_rest: Solution) -> Iterator[Array]:
    """What the mean force of each cell does to the means (R, C), as its motion squared or its size, read or not."""
    acting, read = (each[0].real for each in volts_of_forces(system, at_rest))
    springs = np.array(system.springs_of_channels)
    for spring in range(acting.shape[1]):
        of_spring = np.flatnonzero(springs == spring)
        if not len(of_spring):
            continue
        power = means.power[:, of_spring[0]]
        for volts in (acting[:, spring], acting[:, spring] + read[:, spring]):
            yield np.outer(power, volts)
            yield np.outer(np.sqrt(power), volts)


def _moment_variance(chi2: Array, dof: Array, weight: Array) -> Array:
    """Variance (c,) beyond the noise, by the method of moments (DerSimonian and Laird, 1986); weights (R, c)."""
    total = weight.sum(axis=0)
    return np.asarray(np.maximum(chi2 - dof, 0.0) / (total - np.sum(weight**2, axis=0) / total))


def _static_sigma(spectra: Spectra, names: Sequence[str]) -> Array:
    """Standard deviation (C,) of one static reading; infinite of channels without any."""
    sigma = np.full(len(names), np.inf)
    for points in spectra.statics:
        channels = [names.index(name) for name in points.channel_names]
        sigma[channels] = np.minimum(sigma[channels], np.sqrt(np.diag(points.covariance)))
    return sigma


def _with_drift(run: RunSpectrum, drift: ZeroDrift) -> RunSpectrum:
    lines = np.flatnonzero(run.frequency == 0)
    variance = np.zeros(run.covariance.shape[1])
    for name, sigma in zip(drift.channels, drift.sigma, strict=True):
        if name in run.channel_names:
            variance[run.channel_names.index(name)] = 4.0 * sigma**2
    added = np.zeros(run.covariance.shape)
    added[lines] = np.diag(variance)
    window = None if run.window is None else replace(run.window, covariance=run.window.covariance + added)
    return replace(run, covariance=run.covariance + added, window=window)
