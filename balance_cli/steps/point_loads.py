"""The step `apply`: static loads of point tables and static runs from their readings, by a calibration.

No rotor, no pulses and no record in time: each row is one reading. The calibration model of all trims gives the loads
where there is one, otherwise the matrix of the nearest trim.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.doubted_loads import add_doubted_change
from balance_cli.calibration.hysteresis import loop_covariance
from balance_cli.calibration.math_model import CalibrationModel, zero_scatter
from balance_cli.calibration.noniterative_model import NonIterativeModel
from balance_cli.calibration.result import Calibration
from balance_cli.calibration.trim_model import model_of_trim
from balance_cli.calibration.untested_products import UntestedProducts, untested_components
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.independence import has_independent_columns
from balance_cli.campaign.rig.load_components import load_components, moment_transfer
from balance_cli.io.errors import UserError
from balance_cli.reduction.mean_loads import redundancy_chi2, redundancy_limit
from balance_cli.reduction.untested_loads import sensors_of_channels, untested_points
from balance_cli.reduction.weighted_least_squares import LoadEquations
from balance_cli.signals import distributions as stats
from balance_cli.signals.distributions import CONFIDENCE, student_widening
from balance_cli.steps.point_attitude import rows_of_unknown_weight, weight_covariance, weight_of_metric_part
from balance_cli.steps.point_flags import RowTests, point_flags
from balance_cli.steps.point_zeros import CALIBRATION_ZERO, PointReadings, SubtractedZero, ZeroReading, change_from_zero

Array = NDArray[np.float64]
Index = NDArray[np.intp]

INTERVAL_SIGMAS = float(stats.norm.ppf(0.5 + 0.5 * CONFIDENCE))
CONVERGENCE_SHARE = 1e-6
"""Of the calibrated range, within which the model must reproduce the readings: far below any noise."""

ROWS_AT_ONCE = 1000
"""Rows of one matrix product: with 96 terms, 15 channels and 6 loads some 10 MB, and no short calls row by row."""


@dataclass(frozen=True)
class PointLoads:
    """Loads (n, k) [N, N m] of one run, with `covariance` (n, k, k), half the prediction `interval` (n, k), flags (n,).

    `zero`: which zero was subtracted, in words. `redundancy` (n,): chi-square per degree of freedom of the residual
    test, NaN without redundant channels; `method`: which model gave the loads. `applied` as in the readings.
    """

    run: str
    components: tuple[str, ...]
    loads: Array
    covariance: Array
    interval: Array
    flags: tuple[str, ...]
    redundancy: Array
    zero: str
    method: str
    left_out: tuple[str, ...]
    applied: Array | None

    @property
    def sigma(self) -> Array:
        """Standard deviation (n, k) of the loads."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)))


@dataclass(frozen=True)
class _Model:
    """The model of a calibration with the channels (rows) that a run has, and the noise of a reading (c, c)."""

    model: CalibrationModel
    rows: Index
    noise: Array
    calibration: Calibration
    untested: UntestedProducts | None = None


def point_loads(
    readings: PointReadings, calibration: Calibration, zero: ZeroReading | None = None, non_iterative: bool = False
) -> PointLoads:
    """Compute the loads of each row, relative to the unloaded balance, by the non-iterative model where there is one.

    With `non_iterative` it is required, and all channels with it.

    The zero is that of the rows marked as such, of their own group or of all groups; without any it is `zero`, and
    without that the mean zero of the calibration (flag `no zero`). Rows outside the calibrated loads are flagged.

    Raises UserError where the channels of the readings do not determine the loads.
    """
    model = _usable_model(readings, calibration)
    weight = partial(weight_of_metric_part, calibration)
    change, subtracted = change_from_zero(readings, model.model, model.rows, weight, zero)
    direct = _non_iterative_model(model, non_iterative)
    loads, converged, method = _solve(model, change, direct)
    safe = np.where(converged[:, None], loads, 0.0)
    noise = _reading_covariances(readings, model, subtracted)
    covariance = _load_covariances(model, direct, change, safe, noise)
    covariance, untested_names = _add_untested_products(model, safe, covariance)
    redundancy, limit, untested = _residual_test(model, change, safe, noise, covariance)
    covariance *= np.where(redundancy > limit, redundancy, 1.0)[:, None, None]
    if direct is None:
        covariance *= _widening(model) * model.model.weight_widening(model.rows)
    covariance = covariance + loop_covariance(calibration) + weight_covariance(readings, calibration, zero)
    covariance, doubted = add_doubted_change(calibration.all_trims, safe, covariance)
    loads[~converged], covariance[~converged] = np.nan, np.nan
    tests = RowTests(
        misfit=redundancy > limit,
        unknown_weight=rows_of_unknown_weight(readings, calibration, zero),
        no_zero=subtracted.words == CALIBRATION_ZERO,
        untested=untested,
        untested_names=untested_names,
        doubted=doubted,
    )
    return PointLoads(
        run=readings.run,
        components=model.model.components,
        loads=loads - weight(readings.gravity),
        covariance=covariance,
        interval=np.asarray(INTERVAL_SIGMAS * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))),
        flags=point_flags(model.model, loads, covariance, tests),
        redundancy=redundancy,
        zero=subtracted.words,
        method=method,
        left_out=tuple(name for name in model.model.channel_names if name not in readings.channel_names),
        applied=readings.applied,
    )


def _usable_model(readings: PointReadings, calibration: Calibration) -> _Model:
    all_trims = calibration.all_trims
    if all_trims is None:
        if len(calibration.trims) > 1:
            fault = "has several trims and no calibration model of all trims"
            raise UserError(fault, "calibration", remedy="Calibrate with the runs of one trim")
        model = model_of_trim(next(iter(calibration.trims.values())))
        noise = model.residual_covariance
    else:
        model, noise = all_trims.loads_model, all_trims.noise.reading_covariance
    rows = np.array([i for i, name in enumerate(model.channel_names) if name in readings.channel_names], np.intp)
    k = len(model.components)
    if not has_independent_columns(model.coefficients[:k, rows].T):
        lost = [name for name in model.channel_names if name not in readings.channel_names]
        fault = f"its channels do not determine the loads (absent: {', '.join(lost) or 'none'})"
        raise UserError(fault, readings.run, "channels", f"Give columns of {', '.join(model.channel_names)}")
    untested = None if all_trims is None else all_trims.untested_products
    return _Model(model, rows, noise[np.ix_(rows, rows)], calibration, untested)


def move_moment_center(loads: PointLoads, geometry: Geometry, center: Sequence[float]) -> PointLoads:
    """The same loads with moments about the point `center` [m] instead of the hub.

    Raises UserError where the components are not hub loads.
    """
    if not load_components(geometry).are_hub_loads:
        fault = f"the components {', '.join(loads.components)} have their own lines of action"
        raise UserError(fault, "--moment-center", remedy="Leave it out")
    at = [COMPONENTS.index(name) for name in loads.components]
    move = moment_transfer(geometry.hub, center)[np.ix_(at, at)]
    covariance = move @ loads.covariance @ move.T
    quantile = loads.interval / loads.sigma
    return replace(
        loads,
        loads=loads.loads @ move.T,
        covariance=covariance,
        interval=quantile * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)),
        applied=None if loads.applied is None else loads.applied @ move.T,
    )


# ---- loads -----------------------------------------------------------------------------------------------------------


def _non_iterative_model(usable: _Model, required: bool) -> NonIterativeModel | None:
    """The non-iterative model, if there is one for all the channels; raises UserError where it is required."""
    all_trims = usable.calibration.all_trims
    direct = None if all_trims is None else all_trims.non_iterative
    if direct is not None and len(usable.rows) == len(usable.model.channel_names):
        return direct
    if required:
        fault = "the calibration has no non-iterative model" if direct is None else "a channel is absent"
        raise UserError(fault, "--method", remedy="Calibrate with --non-iterative, or use the iteration")
    return None


def _load_covariances(
    usable: _Model, direct: NonIterativeModel | None, change: Array, loads: Array, noise: Array
) -> Array:
    """Covariance (n, k, k) of the loads by the errors of readings (n, c, c) and coefficients.

    Those of the non-iterative method are widened for the degrees of freedom, as its coefficients have their own.
    """
    model, rows = usable.model, usable.rows
    if direct is not None:
        pairs = zip(change, _widening(usable) * noise, strict=True)
        covariance = np.stack([direct.load_covariance(row, own, usable.noise) for row, own in pairs])
        truncation = direct.truncation(change, model)
        return np.asarray(covariance + truncation[:, :, None] * truncation[:, None, :])
    return np.concatenate([model.load_covariance(loads[part], noise[part], rows) for part in _blocks(len(loads))])


def _blocks(count: int) -> list[slice]:
    """The rows in blocks of ROWS_AT_ONCE."""
    return [slice(start, start + ROWS_AT_ONCE) for start in range(0, count, ROWS_AT_ONCE)]


def _widening(usable: _Model) -> float:
    """Factor on variances of few degrees of freedom: 1.96 standard deviations then cover 95 %, as those of `reduce`."""
    return float(student_widening(usable.model.dof[usable.rows].min()))


def _solve(usable: _Model, change: Array, direct: NonIterativeModel | None) -> tuple[Array, NDArray[np.bool_], str]:
    """Loads (n, k), which of them the method found, and the method in words."""
    model, rows, all_trims = usable.model, usable.rows, usable.calibration.all_trims
    if direct is not None:
        loads = direct.loads(change)
        return loads, np.asarray(np.isfinite(loads).all(axis=1)), "non-iterative"
    loads, _ = model.loads(change, rows)
    with np.errstate(all="ignore"):
        left = (change - model.readings(loads)[:, rows]) @ model.inverse(rows).T
    converged = np.asarray(np.all(np.abs(left) < CONVERGENCE_SHARE, axis=1))
    if all_trims is not None and all_trims.random_terms is not None:
        return loads, converged, "iterative, random terms"
    return loads, converged, "iterative" if model.is_nonlinear else "linear"


def _reading_covariances(readings: PointReadings, usable: _Model, subtracted: SubtractedZero) -> Array:
    """Covariance (n, c, c) of each reading less its zero, with that of what was taken off it before."""
    scatter = zero_scatter(usable.model.zeros)[np.ix_(usable.rows, usable.rows)]
    noise = (1.0 + subtracted.variance)[:, None, None] * usable.noise + subtracted.scatter[:, None, None] * scatter
    if readings.covariance is None:
        return noise
    at = [readings.channel_names.index(usable.model.channel_names[i]) for i in usable.rows]
    return np.asarray(noise + readings.covariance[:, at][:, :, at])


def _add_untested_products(
    usable: _Model, loads: Array, covariance: Array
) -> tuple[Array, tuple[tuple[str, ...], ...]]:
    """Covariance (n, k, k) with that by products that the calibration could not tell, and what they widen."""
    if usable.untested is None:
        return covariance, ((),) * len(loads)
    total = covariance + usable.untested.load_covariance(usable.model, loads, usable.rows)
    pairs = zip(total, covariance, strict=True)
    names = usable.model.components
    return total, tuple(untested_components(names, np.diag(wide), np.diag(tested)) for wide, tested in pairs)


def _residual_test(
    usable: _Model, change: Array, loads: Array, noise: Array, load_covariance: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Chi-square per degree of freedom (n,) of the redundant channels of each row, and its 99.9 % point (n,).

    Third, the loads (n, k) that no redundant sensor tests.
    """
    model, rows = usable.model, usable.rows
    degrees, chi2 = len(rows) - len(model.components), np.full(len(loads), np.nan)
    untested = np.ones(loads.shape, bool)
    if degrees <= 0:
        return chi2, np.full(len(loads), np.inf), untested
    limit, sources = np.full(len(loads), redundancy_limit(degrees)), sensors_of_channels(usable.calibration.geometry)
    sensors = [sources.get(model.channel_names[row], "") for row in rows]
    sigma = np.sqrt(np.diagonal(load_covariance, axis1=1, axis2=2)) / model.calibrated_range
    for part in _blocks(len(loads)):
        covariance = noise[part] + model.model_covariance(loads[part], rows)
        if usable.untested is not None:
            covariance = covariance + usable.untested.reading_covariance(loads[part], rows)
        residual = change[part] - model.readings(loads[part])[:, rows]
        J = model.jacobian(loads[part], rows)
        chi2[part] = redundancy_chi2(residual, J, covariance)
        if np.isfinite(covariance).all():
            W = np.linalg.inv(covariance)
            JW = J.swapaxes(1, 2) @ W
            estimator = np.asarray(np.linalg.solve(JW @ J, JW), np.float64)
            equations = LoadEquations(J, change[part], covariance, estimator)
            untested[part] = untested_points(equations, sensors, limit[part], sigma[part])
    return chi2 / degrees, limit, untested
