"""Zeros of channels, and their drift from run to run: everyday for bridges, and of no use to an identification.

The mean of a swept record is that of its loads through the static response, and the channel's zero:

    y_rc = sum_j T_cj (u_rj - o_j) + z_c + e_rc

with a zero z_c and a load offset o_j that are the same in all runs. Where the e of a channel scatter more than their
noise, its zero drifts. Its variance then belongs to the means, so that no effect explains what is none. The
quadratic force of a cell shifts means, too, but in proportion to the power of its motion, and in the channels of the
whole plate: where one such cell describes most of what is left, it is left to the search. Channels that curve shift
their own means in proportion to the power of their readings: where that describes most, it stands beside the zeros, and
is left to the search as well. Other forces shift means in
other ways. Once the search has found one, the means that it has by the motion are no drift; a dry contact, which rests
with another force in each run, is named as what may drift in place of the zeros.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.channel_means import (
    ChannelMeans,
    MeanRegression,
    cell_patterns,
    channel_means,
    contact_columns,
    curvature_columns,
    nonlinear_means,
    shared_columns,
)
from balance_cli.diagnosis.data_test_settings import DataTestSettings
from balance_cli.diagnosis.result import EXPLAINED, NOTHING_MISSING, PARTLY_EXPLAINED, Diagnosis, ModelFreeTest
from balance_cli.diagnosis.significance import bonferroni_p_value, chi2_p_value
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.model.system import System
from balance_cli.model.system_response import Solution, response, solve
from balance_cli.signals.run_spectrum import RunSpectrum

Array = NDArray[np.float64]

ZERO_DRIFT_TEST = "zeros, run against run"


@dataclass(frozen=True)
class ContactShare:
    """Dry contacts (`places`) of the updated model and the `share` of a drift that they describe by what they hold.

    `left`: the drift that remains beside them.
    """

    places: tuple[str, ...]
    share: float
    left: ZeroDrift | None


@dataclass(frozen=True)
class ZeroDrift:
    """Channels whose zeros drift, and the standard deviation of these from run to run [V].

    `static_sigma`: of one static reading of each channel [V], infinite without any; chi-square of all drifting
    channels, its degrees of freedom and its p-value, corrected for the number of channels. `contacts`: what may drift
    in place of the zeros.
    """

    channels: tuple[str, ...]
    sigma: Array
    static_sigma: Array
    chi2: float
    dof: float
    p_value: float
    contacts: ContactShare | None = None

    @property
    def is_significant(self) -> bool:
        """Whether a zero drifts by more than a reading of a calibration scatters, so that it is what limits means.

        What a contact holds is in sigma of mean loads.
        """
        if self.contacts is not None:
            return self.contacts.left is not None and self.contacts.left.is_significant
        return bool(np.any(self.sigma > self.static_sigma))

    @property
    def test(self) -> ModelFreeTest:
        """The row of the data tests."""
        places = ", ".join(self.channels)
        finding = f"the {self._subject} {self._sizes}"
        return ModelFreeTest(ZERO_DRIFT_TEST, places, self.chi2, self.dof, self.p_value, finding)

    @property
    def note(self) -> str:
        """One sentence, with what follows for the loads."""
        text = f"{self._subject}, which no harmonic load depends on, {self._sizes}"
        if self.is_significant:
            return f"{text}: a mean load is off by what they drift after its zero record; record zeros before and after"
        if self.contacts is not None:
            return f"{text}; what a contact holds is in sigma of the mean loads"
        return f"{text}, less than a static reading scatters"

    @property
    def _subject(self) -> str:
        if self.contacts is None:
            return "zeros"
        where = " and ".join(self.contacts.places)
        return f"zeros, or means by what the contact at {where} holds at rest ({self.contacts.share:.0%} of it)"

    @property
    def _sizes(self) -> str:
        sizes = ", ".join(f"{name} {size:.2g} V" for name, size in zip(self.channels, self.sigma, strict=True))
        return f"drift from run to run (rms): {sizes}"


@dataclass(frozen=True)
class Zeros:
    """What the means of sweeps tell of the zeros of channels: those that differ from none [V], and their drift."""

    offsets: dict[str, float]
    drift: ZeroDrift | None


def find_zeros(system: System, spectra: Spectra, settings: DataTestSettings) -> Zeros:
    """Return the zeros of channels and their drift; nothing where a cell's own force may be what shifts the means."""
    limits = settings.zero_drift
    if system.equations.nonlinear_terms:
        return Zeros({}, None)
    sweep_means = _SweepMeans.of(system, spectra, settings)
    if sweep_means.tested.sum() < limits.min_channels:
        return Zeros({}, None)
    sweep_means = sweep_means.beside_curvature(settings)
    regression = sweep_means.regression(sweep_means.columns)
    patterns = list(cell_patterns(system, sweep_means.means, sweep_means.at_rest))
    drift = sweep_means.drift(regression, settings) if regression.largest_share(patterns) <= limits.cell_share else None
    if drift is not None:
        sweep_means.variance[:, [sweep_means.names.index(name) for name in drift.channels]] += drift.sigma**2
        regression = sweep_means.regression(sweep_means.columns)
    is_clear = sweep_means.regression(sweep_means.columns[:0]).largest_share(patterns) <= limits.cell_share
    return Zeros(_clear_offsets(regression, sweep_means.tested, sweep_means.names, settings) if is_clear else {}, drift)


def share_with_forces(
    drift: ZeroDrift | None, system: System, spectra: Spectra, settings: DataTestSettings
) -> ZeroDrift | None:
    """Return what nonlinear terms of the updated system leave of a drift, with the part that dry contacts describe.

    The means that the motion determines are known. In each run a contact holds a force of its own, the same for all
    channels; it is named where that is most of the drift. `spectra` are those without the drift.
    """
    contacts = tuple(force for force in system.equations.forces if force.held is not None)
    if drift is None or not system.equations.nonlinear_terms:
        return drift
    sweep_means = _SweepMeans.of(system, spectra, settings)
    if len(contacts) < system.equations.nonlinear_terms:
        drift = sweep_means.drift(sweep_means.regression(sweep_means.columns), settings)
    if drift is None or not contacts:
        return drift
    held = contact_columns(system, sweep_means.means, sweep_means.at_rest, contacts)
    share, beside = sweep_means.share(held)
    if share <= settings.zero_drift.cell_share:
        return drift
    places = tuple(system.equations.springs[force.spring] for force in contacts)
    return replace(drift, contacts=ContactShare(places, share, sweep_means.drift(beside, settings)))


@dataclass(frozen=True)
class _SweepMeans:
    """Means of the sweeps, without those of their loads and of nonlinear terms, and what all runs share.

    `names` of the C channels, `tested` (C,) those with means in enough runs; `columns` (p, R, C); `volts` and their
    `variance` (R, C) with the error of the response, infinite where they take no part; `static_sigma` (C,) of a static
    reading.
    """

    names: tuple[str, ...]
    means: ChannelMeans
    at_rest: Solution
    tested: NDArray[np.bool_]
    columns: Array
    volts: Array
    variance: Array
    static_sigma: Array

    @classmethod
    def of(cls, system: System, spectra: Spectra, settings: DataTestSettings) -> _SweepMeans:
        """The means of the spectra, beside the response of the system at rest."""
        names, limits = system.channel_names, settings.zero_drift
        means, at_rest = channel_means(spectra.lines, names), solve(system, np.zeros(1))
        T = response(system, at_rest)[0].real
        tested = np.isfinite(means.variance).sum(axis=0) >= limits.min_runs
        variance = means.variance + (limits.response_error * np.abs(means.loads) @ np.abs(T).T) ** 2
        variance[:, ~tested] = np.inf
        columns = shared_columns(T, means, tested)
        volts = means.volts - means.loads @ T.T - nonlinear_means(spectra.lines, system, at_rest)
        return cls(names, means, at_rest, tested, columns, volts, variance, _static_sigma(spectra, names))

    def regression(self, columns: Array) -> MeanRegression:
        """The regression of the means on columns."""
        return MeanRegression.of(columns, self.volts, self.variance)

    def share(self, columns: Array) -> tuple[float, MeanRegression]:
        """The share of the squared residual that further columns describe, and the regression with them."""
        without = self.regression(self.columns)
        beside = self.regression(np.concatenate([self.columns, columns]))
        return 1.0 - float(beside.channel_chi2.sum() / max(without.channel_chi2.sum(), np.finfo(float).tiny)), beside

    def beside_curvature(self, settings: DataTestSettings) -> _SweepMeans:
        """The same beside curvature of the channels, which all runs share, where it describes most of a drift."""
        if self.drift(self.regression(self.columns), settings) is None:
            return self
        columns = curvature_columns(self.means, self.tested)
        describes = self.share(columns)[0] > settings.zero_drift.cell_share
        return replace(self, columns=np.concatenate([self.columns, columns])) if describes else self

    def drift(self, regression: MeanRegression, settings: DataTestSettings) -> ZeroDrift | None:
        """The drift that a regression leaves."""
        return _drift(regression, self.static_sigma, self.names, self.means.noise_dof, settings)


def _drift(
    regression: MeanRegression, static_sigma: Array, names: Sequence[str], noise_dof: float, settings: DataTestSettings
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
    regression: MeanRegression, tested: NDArray[np.bool_], names: Sequence[str], settings: DataTestSettings
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
    if drift.is_significant and verdict in (NOTHING_MISSING, EXPLAINED):
        verdict = PARTLY_EXPLAINED
    tests, notes = (*diagnosis.data_tests, drift.test), (*diagnosis.notes, drift.note)
    return replace(diagnosis, data_tests=tests, notes=notes, verdict=verdict)


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
