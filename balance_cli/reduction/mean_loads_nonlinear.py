"""Mean hub loads (harmonic 0) by nonlinear calibration: iteration with the calibration model of all trims."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.convergence import Contraction
from balance_cli.calibration.load_method import NON_ITERATIVE, iteration_name
from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.noniterative_model import NonIterativeModel
from balance_cli.calibration.result import Calibration
from balance_cli.calibration.static_matrices import lack_of_fit
from balance_cli.calibration.untested_products import (
    describe_untested,
    untested_components,
)
from balance_cli.campaign.recording.channel_health import ChannelHealth
from balance_cli.campaign.rig.components import UNIT_OF
from balance_cli.campaign.rig.independence import has_independent_columns
from balance_cli.io.errors import UserError
from balance_cli.reduction.mean_loads import (
    CalibrationZeros,
    MeanLoads,
    MeanReading,
    flag_extrapolated,
    mean_load_redundancy,
    mean_reading,
    run_flags,
    undetermined_loads_error,
)
from balance_cli.reduction.untested_loads import sensors_of_channels, untested_means
from balance_cli.reduction.vibration_shift import SHIFT_ERROR, VibrationShift, vibration_shift
from balance_cli.reduction.weighted_least_squares import LoadEquations
from balance_cli.reduction.wind_off import ZeroRecord
from balance_cli.signals.distributions import student_widening
from balance_cli.signals.rotor.harmonics import Harmonics

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MIN_SINGULAR_VALUE_SIGNIFICANCE = 5.0
"""Standard errors by which the least singular value of the linear part must differ from zero, as in `calibrate`."""
ALL_TRIMS = "all trims"
"""Label in the place of that of a trim."""


@dataclass(frozen=True)
class _UsableChannels:
    """The model with the channels (rows) that are usable in one run; `left_out`: the others, with the reason."""

    model: CalibrationModel
    rows: Index
    run: str
    left_out: dict[str, str]

    @property
    def left_out_note(self) -> str:
        """The channels left out, as part of a message."""
        lost = "; ".join(f"{name}: {reason}" for name, reason in self.left_out.items())
        return f" (left out: {lost})" if lost else ""


def nonlinear_mean_loads(
    spectra: Harmonics,
    calibration: Calibration,
    model: CalibrationModel,
    health: ChannelHealth,
    zero: ZeroRecord | None,
    deviations: Array | None = None,
) -> MeanLoads:
    """Compute the mean loads of one run, relative to the unloaded rig, by iteration with `model`.

    `deviations` (m, c): readings of the model's channels about their means, from which follows what vibration adds to
    these (`reduction.vibration_shift`).

    The unloaded rig is that of the zero record or, without one, the mean of the zeros of the calibration. Where the
    calibration determined the weight of the metric part, the iteration includes that of the level rig. Where all
    channels are usable and the calibration has a non-iterative model, that model computes the loads.

    Raises UserError where the remaining channels do not determine the loads, or convergence of the iteration is not
    proved.
    """
    all_trims = calibration.all_trims
    reading = _mean_reading(spectra, calibration, model, health, zero)
    rows = np.array(reading.rows, dtype=np.intp)
    if not _loads_determined(model, rows):
        raise undetermined_loads_error(health, spectra.run)
    left_out = {name: reason for name, reason in health.left_out.items() if name in model.channel_names}
    usable = _UsableChannels(model, rows, spectra.run, left_out)
    direct = None if all_trims is None or len(rows) < len(model.channel_names) else all_trims.non_iterative

    def solve(change: Array) -> Array:
        return _solve_loads(usable, change) if direct is None else direct.loads(change)

    reached = loads = solve(reading.change)
    if deviations is not None:
        oscillating = vibration_shift(model, rows, loads[0], deviations)
        reading = _without_shift(reading, oscillating)
        reached, loads = oscillating.loads[None], solve(reading.change)
    result = _describe_loads(calibration, model, reading, loads, (direct, zero), reached)
    if direct is not None or all_trims is None or all_trims.non_iterative is None:
        return result
    absent = [name for i, name in enumerate(model.channel_names) if i not in reading.rows]
    note = f"mean loads by iteration: the non-iterative method needs {', '.join(absent)}"
    return replace(result, note="; ".join(filter(None, [result.note, note])))


def _mean_reading(
    spectra: Harmonics,
    calibration: Calibration,
    model: CalibrationModel,
    health: ChannelHealth,
    zero: ZeroRecord | None,
) -> MeanReading:
    """The mean readings of one run less those of the unloaded rig, whose metric part is level."""
    all_trims = calibration.all_trims
    level = np.zeros(len(model.components)) if all_trims is None else all_trims.level_weight_loads
    natural = model.zeros.mean(axis=0)
    if all_trims is not None:
        natural = natural + all_trims.readings_beside_shaft(None, model.channel_names)[0]
    zeros = CalibrationZeros(natural + model.readings(level[None])[0], model.zeros)
    return mean_reading(model.channel_names, natural, zeros, spectra, health, zero)


def _describe_loads(
    calibration: Calibration,
    model: CalibrationModel,
    reading: MeanReading,
    loads: Array,
    origin: tuple[NonIterativeModel | None, ZeroRecord | None],
    reached: Array,
) -> MeanLoads:
    """Mean loads (1, k) with their errors and flags; `origin`: the other model where it gave them, and the zero.

    Products that were not tested are as uncertain as those of the loads (1, k) that a vibration has `reached`.
    """
    all_trims, (direct, zero) = calibration.all_trims, origin
    assert all_trims is not None
    rows = np.array(reading.rows, dtype=np.intp)
    J = model.jacobian(loads, rows)[0]
    coefficient_covariance = model.model_covariance(loads, rows)[0]
    noise = reading.covariance + _widened_covariance(calibration, rows, coefficient_covariance)
    total_covariance = noise + coefficient_covariance
    linearized = np.diag(model.load_covariance(loads, noise, rows)[0])
    tested = linearized if direct is None else _non_iterative_variance(direct, calibration, reading)
    variance, products = tested, all_trims.untested_products
    if products is not None:
        total_covariance = total_covariance + products.reading_covariance(reached, rows)[0]
        variance = tested + np.diag(products.load_covariance(model, reached, rows)[0])
    redundancy, limit = mean_load_redundancy(reading.change - model.readings(loads)[0, rows], J, total_covariance)
    outside = untested_components(model.components, variance, tested)
    sigma = np.sqrt(variance * (redundancy if redundancy > limit else 1.0))
    equations = _weighted_equations(J, reading.change, total_covariance)
    names = [sensors_of_channels(calibration.geometry).get(model.channel_names[row], "") for row in rows]
    untested = untested_means(equations, names, limit, sigma / model.calibrated_range)  # loads of J are relative to it
    mean_loads = MeanLoads(
        components=model.components,
        loads=loads[0] - all_trims.level_weight_loads,
        sigma=sigma,
        trim=ALL_TRIMS,
        flags=run_flags(zero, redundancy > limit, untested | np.isnan(redundancy)),
        redundancy=redundancy,
        redundancy_limit=limit,
        condition=_jacobian_condition(J, model.residual_covariance[np.ix_(rows, rows)]),
        method=iteration_name(all_trims) if direct is None else NON_ITERATIVE,
        note="" if products is None or not outside else describe_untested(products, reached[0], outside),
    )
    return flag_extrapolated(mean_loads, (*model.extrapolated_components(loads[0]), *outside))


def _weighted_equations(J: Array, change: Array, covariance: Array) -> LoadEquations:
    """Return the equations of loads for the change (c,) of readings, J (c, k), weighted by the covariance (c, c)."""
    W = np.linalg.inv(covariance)
    return LoadEquations(J, change, covariance, np.asarray(np.linalg.solve(J.T @ W @ J, J.T @ W)))


def _without_shift(reading: MeanReading, oscillating: VibrationShift) -> MeanReading:
    """The mean readings without what vibration adds to them, and with its error."""
    shift = oscillating.readings
    covariance = reading.covariance + SHIFT_ERROR**2 * np.outer(shift, shift)
    return replace(reading, change=reading.change - shift, covariance=covariance)


def _non_iterative_variance(direct: NonIterativeModel, calibration: Calibration, reading: MeanReading) -> Array:
    """Variance (k,) [N2, (N m)2] of loads by the non-iterative method, with all that the iteration's contains.

    The residuals of the method contain the noise of a row of the calibration; the rest is misfit, which does not
    average out.
    """
    assert calibration.all_trims is not None
    model = calibration.all_trims.loads_model
    row_noise = (1.0 - _misfit_share(calibration, model)) * model.residual_covariance
    covariance = direct.load_covariance(reading.change, reading.covariance, row_noise)
    return np.asarray(np.diag(covariance) + direct.truncation(reading.change, model)[0] ** 2)


def _loads_determined(model: CalibrationModel, rows: Index) -> bool:
    """Whether the linear part of these channels determines the loads, beyond the errors of its coefficients."""
    k = len(model.components)
    C = model.coefficients[:k, rows].T
    if not has_independent_columns(C):
        return False
    unit = 1.0 / np.sqrt(np.diagonal(model.residual_covariance)[rows])
    U, s, Vt = np.linalg.svd(unit[:, None] * C, full_matrices=False)
    u, v = U[:, -1] * unit, Vt[-1]
    variance = u**2 @ np.einsum("i,cij,j->c", v, model.covariance[rows, :k, :k], v)
    return bool(s[-1] > MIN_SINGULAR_VALUE_SIGNIFICANCE * np.sqrt(variance))


def _jacobian_condition(J: Array, covariance: Array) -> float:
    """Condition of the Jacobian (c, k), loads in units of the calibrated range, channels of their residuals."""
    return float(np.linalg.cond(J / np.sqrt(np.diagonal(covariance))[:, None]))


def _widened_covariance(calibration: Calibration, rows: Index, coefficients: Array) -> Array:
    """Covariance (c, c) of the misfit, and by what that of the coefficients is widened for the degrees of freedom."""
    assert calibration.all_trims is not None
    widening = student_widening(calibration.all_trims.loads_model.dof[rows].min())
    return np.asarray(widening * _misfit_covariance(calibration, rows) + (widening - 1.0) * coefficients)


def _misfit_covariance(calibration: Calibration, rows: Index) -> Array:
    """Covariance (c, c) of the misfit of the model beyond noise, which does not average out over a record."""
    assert calibration.all_trims is not None
    model = calibration.all_trims.loads_model
    share = _misfit_share(calibration, model)
    predicted_errors = 1.0 + share * (model.press_ratio[rows] - 1.0)
    return np.asarray(
        share * model.residual_covariance[np.ix_(rows, rows)] * predicted_errors[:, None] * predicted_errors
    )


def _misfit_share(calibration: Calibration, model: CalibrationModel) -> float:
    """Share of the residual covariance that is not noise, from the noise of the trims; 1 where that is not known."""
    with_known_noise = [trim for trim in calibration.trims.values() if np.isfinite(trim.lack_of_fit)]
    if not with_known_noise:
        return 1.0
    noise = np.zeros_like(model.residual_covariance)
    for trim in with_known_noise:
        at = [trim.channel_names.index(name) for name in model.channel_names]
        noise += trim.rows * trim.noise_covariance[np.ix_(at, at)]
    noise /= sum(trim.rows for trim in with_known_noise)
    misfit = lack_of_fit(model.residual_covariance, noise, sum(trim.dof for trim in with_known_noise))
    return max(0.0, 1.0 - 1.0 / misfit)


def _solve_loads(usable: _UsableChannels, change: Array) -> Array:
    """Loads (1, k) for the change (c,) of the readings; raises UserError where convergence is not proved."""
    model, rows = usable.model, usable.rows
    proof = model.contraction(rows)
    if not proof.is_proved:
        fault = f"the iteration for the mean loads is not proved to converge{usable.left_out_note}"
        remedy = "Calibrate with --terms linear or over smaller loads, repair the channels, or leave the run out"
        raise UserError(fault, usable.run, f"mean of {', '.join(model.components)}", f"{remedy} with --skip-bad")
    loads, is_valid = model.loads(change, rows)
    if not is_valid[0]:
        raise _unproved_loads_error(usable, proof, change, loads[0])
    return loads


def _unproved_loads_error(usable: _UsableChannels, proof: Contraction, change: Array, loads: Array) -> UserError:
    """The error to raise for a run whose loads (k,) lie outside the reach of the proof."""
    model = usable.model
    # Far outside the reach the iteration diverges: the linear part then gives the approximate loads.
    x = loads / model.calibrated_range
    if not np.isfinite(x).all():
        x = model.inverse(usable.rows) @ change
    ratio = np.abs(x) / proof.reach
    worst = [j for j in range(len(x)) if ratio[j] > 1.0] or [int(np.argmax(ratio))]
    place = ", ".join(model.components[j] for j in worst)
    excess = "; ".join(_describe_excess(model, proof, x, j) for j in worst)
    fault = f"the mean lies outside the range of proved convergence: {excess}{usable.left_out_note}"
    remedy = "Calibrate over larger loads, check channels and zero run, or leave the run out with --skip-bad"
    return UserError(fault, usable.run, f"mean of {place}", remedy)


def _describe_excess(model: CalibrationModel, proof: Contraction, x: Array, j: int) -> str:
    """Describe a load as `Fz of about 5210 N is 1.42 times the calibrated range (3670 N), proved up to 1.31 times`."""
    name, full = model.components[j], float(model.calibrated_range[j])
    unit = UNIT_OF[name]
    size = f"{name} of about {x[j] * full:.4g} {unit} is {abs(x[j]):.3g} times the calibrated range ({full:.4g} {unit})"
    return f"{size}, proved up to {proof.reach[j]:.3g} times"
