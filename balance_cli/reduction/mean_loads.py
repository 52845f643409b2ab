"""Mean hub loads (harmonic 0) from strain and torque channels by the static matrix of the nearest trim.

Where the calibration model is nonlinear, `balance_cli.reduction.mean_loads_nonlinear` is used instead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.load_method import MATRIX
from balance_cli.calibration.math_model import zero_scatter
from balance_cli.calibration.result import Calibration, TrimCalibration
from balance_cli.campaign.recording.channel_health import ChannelHealth
from balance_cli.campaign.rig.independence import has_independent_columns
from balance_cli.io.errors import UserError
from balance_cli.reduction.flags import EXTRAPOLATED, NO_ZERO, NOT_MEASURED, REDUNDANCY, UNTESTED, join_flags
from balance_cli.reduction.untested_loads import sensors_of_channels, untested_means
from balance_cli.reduction.weighted_least_squares import DOF_PER_REDUNDANT_EQUATION as DOF_PER_EQUATION
from balance_cli.reduction.weighted_least_squares import REDUNDANCY_CONFIDENCE, LoadEquations
from balance_cli.reduction.wind_off import ZeroRecord
from balance_cli.signals import distributions as stats
from balance_cli.signals.distributions import student_widening
from balance_cli.signals.rotor.harmonics import Harmonics

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


MEANS_REMOVED = (
    "the channels have means of zero, closer than their noise permits: were the means taken out of the record? "
    "Give the record as it was measured"
)
"""Note on a run without mean loads."""


@dataclass(frozen=True)
class MeanLoads:
    """Mean loads (m,) [N, N m] of the named components with sigma (m,).

    `trim`: label of the trim whose matrix was used. `flags` (m,): flags of each component, joined by `; `.
    `redundancy`: chi-square per degree of freedom of the residual test, with its limit; `condition` of the matrix.
    `method`: the model that computed them, in words. `note`: what the flags do not say; empty where there is nothing.
    """

    components: tuple[str, ...]
    loads: Array
    sigma: Array
    trim: str
    flags: tuple[str, ...]
    redundancy: float
    redundancy_limit: float
    condition: float
    note: str = ""
    method: str = MATRIX


def unmeasured_mean_loads(components: tuple[str, ...], note: str = "") -> MeanLoads:
    """Return mean loads that no static calibration or no record measures: NaN, each with the flag NOT_MEASURED."""
    unknown, flags, nan = np.full(len(components), np.nan), (NOT_MEASURED,) * len(components), float("nan")
    return MeanLoads(components, unknown, unknown, "", flags, nan, nan, nan, note, method="")


@dataclass(frozen=True)
class MeanReading:
    """Mean readings (c,) [V] of the usable channels (rows) less a reference reading, with covariance (c, c).

    `dof`: real degrees of freedom of the covariance.
    """

    rows: list[int]
    change: Array
    covariance: Array
    dof: float


def linear_mean_loads(
    spectra: Harmonics, calibration: Calibration, health: ChannelHealth, zero: ZeroRecord | None
) -> MeanLoads:
    """Compute mean loads by T0 of the trim nearest in mean load.

    The loads by the first trim decide which trim is nearest. Where channels were left out, the weighted inverse of the
    remaining rows of C0 replaces T0. Loads outside those applied in the calibration are flagged, where these are known.

    Raises UserError where the remaining channels do not determine the loads.
    """
    first = next(iter(calibration.trims.values()))
    sensors = sensors_of_channels(calibration.geometry)
    mean_loads = _loads_by_trim(first, sensors, spectra, health, zero)
    trim = calibration.nearest_trim(dict(zip(mean_loads.components, mean_loads.loads.tolist(), strict=True)))
    if trim is not first:
        mean_loads = _loads_by_trim(trim, sensors, spectra, health, zero)
    all_trims = calibration.all_trims
    if all_trims is None:
        return mean_loads
    total_loads = mean_loads.loads + all_trims.level_weight_loads
    return flag_extrapolated(mean_loads, all_trims.model.extrapolated_components(total_loads))


def flag_extrapolated(loads: MeanLoads, extrapolated_names: Sequence[str]) -> MeanLoads:
    """Flag the named components as EXTRAPOLATED."""
    flags = (
        join_flags((flag, EXTRAPOLATED if name in extrapolated_names else ""))
        for name, flag in zip(loads.components, loads.flags, strict=True)
    )
    return replace(loads, flags=tuple(flags))


def _loads_by_trim(
    trim: TrimCalibration,
    sensors: Mapping[str, str],
    spectra: Harmonics,
    health: ChannelHealth,
    zero: ZeroRecord | None,
) -> MeanLoads:
    unloaded = CalibrationZeros(trim.offsets.mean(axis=0), trim.offsets)
    reading = mean_reading(trim.channel_names, trim.mean_channels, unloaded, spectra, health, zero)
    C0 = trim.C0[reading.rows]
    if not has_independent_columns(C0 * trim.calibrated_range):
        raise undetermined_loads_error(health, spectra.run)
    W = np.linalg.inv(trim.noise_covariance[np.ix_(reading.rows, reading.rows)])
    is_complete = len(reading.rows) == len(trim.channel_names)
    T0 = trim.T0 if is_complete else np.linalg.inv(C0.T @ W @ C0) @ C0.T @ W
    change = T0 @ reading.change
    model_covariance = _model_covariance(trim, reading.rows, change, zero is not None)
    covariance = reading.covariance + model_covariance
    redundancy, limit, tested_covariance = _residual_test(reading, C0, model_covariance, trim)
    sigma = np.sqrt(np.diag(T0 @ covariance @ T0.T) * (redundancy if redundancy > limit else 1.0))
    equations = LoadEquations(C0, reading.change + C0 @ trim.mean_load, tested_covariance, T0)
    names = [sensors.get(trim.channel_names[row], "") for row in reading.rows]
    return MeanLoads(
        components=trim.components,
        loads=trim.mean_load + change,
        sigma=sigma,
        trim=trim.trim,
        flags=run_flags(
            zero, redundancy > limit, untested_means(equations, names, limit, sigma) | np.isnan(redundancy)
        ),
        redundancy=redundancy,
        redundancy_limit=limit,
        condition=trim.condition,
    )


def _residual_test(
    reading: MeanReading, C0: Array, model_covariance: Array, trim: TrimCalibration
) -> tuple[float, float, Array]:
    """Return chi-square per degree of freedom of the redundant channels and its limit, for the matrix of a trim.

    And the covariance (c, c) of the readings that it goes by.

    The test is made in the directions N that no load reaches, N' C0 = 0. The errors of C0 under one load come from the
    few rows that applied it, so that their covariance has hardly an inverse: its size is kept, and the correlation is
    that of the residuals of all rows. So is that of noise of too few degrees of freedom. Degrees of freedom
    are combined by Satterthwaite's formula (Biometrics Bulletin 2, 1946, 110).
    """
    redundant = len(C0) - C0.shape[1]
    if not trim.rows or redundant <= 0:
        covariance = reading.covariance + model_covariance
        return (*mean_load_redundancy(reading.change, C0, covariance), covariance)
    few = reading.dof < DOF_PER_EQUATION * redundant
    residual = trim.residual_covariance[np.ix_(reading.rows, reading.rows)]
    unit = np.sqrt(np.diag(residual))[:, None]
    N = np.linalg.svd(C0 / unit * trim.calibrated_range)[0][:, C0.shape[1] :] / unit
    noise_N, model_N, residual_N = (N.T @ part @ N for part in (reading.covariance, model_covariance, residual))
    size, share = (float(np.trace(np.linalg.solve(residual_N, part))) / redundant for part in (noise_N, model_N))
    sizes = (size, share)
    noise = size * residual if few else reading.covariance
    noise_N = size * residual_N if few else noise_N
    dof = sum(sizes) ** 2 / sum(size**2 / n for size, n in zip(sizes, (reading.dof, trim.dof), strict=True))
    total = noise_N + share * residual_N
    test = mean_load_redundancy(N.T @ reading.change, np.zeros((redundant, 0)), total, dof, few)
    return (*test, noise + share * residual)


def run_flags(zero: ZeroRecord | None, misfit: bool, untested: Mask) -> tuple[str, ...]:
    """Flags (m,) of the components of a run: those that all have in common, and which of them (m,) are untested."""
    words = (NO_ZERO if zero is None else "", REDUNDANCY if misfit else "")
    return tuple(join_flags((*words, UNTESTED if word else "")) for word in untested.tolist())


def _model_covariance(trim: TrimCalibration, rows: list[int], change: Array, counts_from_zero: bool) -> Array:
    """Covariance (c, c) of the readings by the errors of the straight line at a load change (m,), and by its misfit.

    Counted from the center of the rows of the calibration, the reading there has the error of a mean of `trim.rows`
    rows (none where a matrix was given). Counted from a zero record, the change spans the whole load, and the errors
    of C0 act on all of it. Widened for the degrees of freedom of the residuals.
    """
    load = change + trim.mean_load if counts_from_zero else change
    spread = np.einsum("ijkl,j,l->ik", trim.C0_covariance, load, load)
    center = 0.0 if counts_from_zero or not trim.rows else 1.0 / trim.rows
    covariance = student_widening(trim.dof) * (spread + (trim.misfit_share + center) * trim.residual_covariance)
    return np.asarray(covariance[np.ix_(rows, rows)])


@dataclass(frozen=True)
class CalibrationZeros:
    """The reading (c,) [V] of the unloaded rig in the calibration, and the zeros (s, c) of its runs or load series."""

    unloaded: Array
    each: Array


def mean_reading(
    channel_names: Sequence[str],
    reference_reading: Array,
    zeros: CalibrationZeros,
    spectra: Harmonics,
    health: ChannelHealth,
    zero: ZeroRecord | None,
) -> MeanReading:
    """Mean reading of the usable channels less `reference_reading` (c,) and less the zero shift.

    The zero shift is the reading of the zero record less that of the unloaded rig in the calibration. Without a zero
    record it is not known, and scatters as the zeros of the calibration do.
    """
    usable = set(health.live) & set(channel_names)
    if zero is not None:
        usable &= set(zero.channel_names)
    rows = [i for i, name in enumerate(channel_names) if name in usable]
    names = [channel_names[i] for i in rows]
    spectrum_columns = spectra.columns(names)
    change = spectra.amplitude[0, spectrum_columns].real - reference_reading[rows]
    covariance = np.real(spectra.covariance[0][np.ix_(spectrum_columns, spectrum_columns)])
    dof = 2.0 * float(spectra.dof[0])
    covariance *= student_widening(dof)
    if zero is None:
        scatter = zero_scatter(zeros.each)[np.ix_(rows, rows)]
        known = len(zeros.each) > 1
        return MeanReading(rows, change, covariance + scatter, min(dof, len(zeros.each) - 1.0) if known else dof)
    at = [zero.channel_names.index(name) for name in names]
    change = change - (zero.mean[at] - zeros.unloaded[rows])
    covariance = covariance + np.diag(zero.variance[at])
    return MeanReading(rows, change, covariance, min(dof, zero.segments - 1.0))


def undetermined_loads_error(health: ChannelHealth, run: str) -> UserError:
    """The error to raise for a run whose remaining channels do not determine the loads."""
    names = "; ".join(f"{name}: {reason}" for name, reason in health.left_out.items()) or "none"
    return UserError(
        f"the remaining strain and torque channels do not determine the mean loads (left out: {names})",
        run,
        "channels",
        "Repair the channels, or leave the run out with --skip-bad",
    )


def mean_load_redundancy(
    residual: Array, C0: Array, covariance: Array, dof: float = np.inf, variances_only: bool = False
) -> tuple[float, float]:
    """Residual test of the redundant channels: chi-square per degree of freedom, and its 99.9 % point.

    With a covariance of `dof` degrees of freedom it follows Hotelling's distribution; with `variances_only` F.
    """
    degrees = len(C0) - C0.shape[1]
    if degrees <= 0:
        return float("nan"), float("inf")
    chi2 = float(redundancy_chi2(residual, C0, covariance))
    if not np.isfinite(dof):
        return chi2 / degrees, redundancy_limit(degrees)
    second = dof if variances_only else max(dof - degrees + 1.0, 1.0)
    return chi2 / degrees, float(stats.f.ppf(REDUNDANCY_CONFIDENCE, degrees, second)) * max(dof / second, 1.0)


def redundancy_chi2(residual: Array, C0: Array, covariance: Array) -> Array:
    """Chi-square (...) of residuals (..., c) with loads fitted by C0 (..., c, k), for a covariance (..., c, c)."""
    weight, columns = np.linalg.inv(covariance), C0.swapaxes(-1, -2)
    inverse, e = np.linalg.inv(columns @ weight @ C0), residual[..., None]
    projected = e - C0 @ (inverse @ (columns @ (weight @ e)))
    return np.asarray((projected.swapaxes(-1, -2) @ weight @ projected)[..., 0, 0])


def redundancy_limit(degrees: int) -> float:
    """The 99.9 % point of chi-square per degree of freedom."""
    return float(stats.chi2.ppf(REDUNDANCY_CONFIDENCE, degrees)) / degrees
