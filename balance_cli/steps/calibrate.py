"""The step `calibrate`: from static runs to the matrices C0 and T0 of each trim and the model of all trims."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.hysteresis import estimate_hysteresis
from balance_cli.calibration.insignificant_loads import MIN_SIGNIFICANCE, explain_insignificance, fit_with_curvature
from balance_cli.calibration.result import Calibration, TrimCalibration, with_rated_loads
from balance_cli.calibration.static_matrices import (
    TrimRegression,
    TrimRows,
    add_variance_floor,
    inverse_matrix,
    inverse_sigma,
    known_lack_of_fit,
    lack_of_fit_covariance,
    loading_directions,
    regress,
    significance,
    standard_errors,
    zeros_differ,
)
from balance_cli.calibration.term_choice import SEARCHED, TermChoice
from balance_cli.calibration.weight_covariance import weight_covariance
from balance_cli.campaign.recording.run import Run, read_channels
from balance_cli.campaign.rig.attitude import attitude_segments
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.independence import LARGEST_CONDITION
from balance_cli.campaign.rig.load_components import load_components
from balance_cli.io.errors import UserError
from balance_cli.steps.calibrate_all_trims import fit_all_trims, gravity_of_runs
from balance_cli.steps.load_point_rows import load_point_rows
from balance_cli.steps.temperature_correction import fit_without_temperature
from balance_cli.steps.trim_tasks import (
    TrimTask,
    check_attitudes,
    check_loaded,
    fitted_tasks,
    rows_of_tasks,
    run_place,
    trim_tasks,
    with_contradiction,
)

Array = NDArray[np.float64]

MIN_SINGULAR_VALUE_SIGNIFICANCE = 5.0
"""Standard errors by which the least singular value of C0 must differ from zero for it to determine the loads."""
MIN_NULL_SHARE = 0.1
"""Share in the least singular vector from which a component is named in an error."""


def calibrate(
    runs: Iterable[Run],
    geometry: Geometry,
    choice: TermChoice = SEARCHED,
    hold_out: Sequence[Run] = (),
    non_iterative: bool = False,
) -> Calibration:
    """Calibrate from the static runs among `runs`: C0 and T0 for each trim, and one model of all trims.

    Where all runs state their temperature, readings are referred to the mean one by terms of temperature that the
    rows tell. `choice`: the terms of the model, by default those that a search selects for each channel. The static
    runs of `hold_out` are not fitted, but check the model. With `non_iterative` the loads are also fitted as functions
    of the readings. Matrices and model use the same rows: those that the model calls outliers enter neither. The
    calibrated range of a component is the largest load applied to it in these rows.

    Raises UserError where there is no static run, a run has no loads, a trim does not load a component that the balance
    carries, or the usable channels do not determine the loads.
    """
    static = [run for run in runs if run.kind == "static"]
    if not static:
        raise UserError("there is no static run among the runs", remedy="Give the static runs of the calibration")
    components = load_components(geometry)
    for run in static:
        if not run.has_loads:
            column = f"{components.names[0]} [{components.units[0]}]"
            remedy = f"Record the applied loads. In a table they are columns such as `{column}` or `applied {column}`"
            raise UserError("a static run without loads", run_place(run), "loads", remedy)
    check_attitudes(static, components)

    def fit(at_reference: Sequence[Run], held_out: Sequence[Run]) -> Calibration:
        return _calibrate_static(at_reference, geometry, choice, held_out, non_iterative)

    return fit_without_temperature(static, hold_out, geometry, fit)


def _calibrate_static(
    static: Sequence[Run], geometry: Geometry, choice: TermChoice, hold_out: Sequence[Run], non_iterative: bool
) -> Calibration:
    """Calibrate from static runs at one temperature; raises UserError as `calibrate` does."""
    components = load_components(geometry)
    tasks = trim_tasks(load_point_rows(static), geometry, components)
    for task in tasks.values():
        _check_task(task)
    all_trims = fit_all_trims(rows_of_tasks(static, tasks), geometry, hold_out, choice, non_iterative)
    trims, notes = {}, []
    for label, task in fitted_tasks(static, tasks, all_trims).items():
        try:
            trims[label] = _calibrate_trim(task)
        except UserError as error:
            # Without the excluded rows the trim is not determined; with all of them it may be.
            try:
                trims[label] = _calibrate_trim(replace(tasks[label], calibrated_range=task.calibrated_range))
            except UserError as second:
                raise with_contradiction(second, all_trims) from None
            notes.append(f"trim {label}: C0 and T0 include the excluded rows: without them {error.fault}")
    if all_trims is not None and notes:
        all_trims = replace(all_trims, screening_notes=(*all_trims.screening_notes, *notes))
    trims = {label: with_rated_loads(trim, geometry) for label, trim in trims.items()}
    return Calibration(geometry, trims, all_trims)


def _check_task(task: TrimTask) -> None:
    """Raise UserError for a trim whose channels or loads cannot determine its matrices."""
    c, k = len(task.channel_names), len(task.components)
    if c < k:
        fault = f"{c} usable channels cannot determine {k} load components{task.left_out_note}"
        raise task.error(fault, "Repair the channels, or declare the smaller freedom of the rig or its `components`")
    rows = _stack_rows(task)
    check_loaded(task, rows)
    _regress(task, rows)


def _calibrate_trim(task: TrimTask) -> TrimCalibration:
    """Calibrate one trim; raises UserError as `calibrate` does."""
    rows, regression = _regress_with_zeros(task)
    _check_significance(task, rows, regression)
    return _trim_calibration(task, rows, regression)


def _regress_with_zeros(task: TrimTask) -> tuple[TrimRows, TrimRegression]:
    """Regression with one zero for each run or, where these explain significantly more, for each load series."""
    by_run = _stack_rows(replace(task, rows=tuple(replace(each, load_series=None) for each in task.rows)))
    check_loaded(task, by_run)
    regression = _regress(task, by_run)
    rows = _stack_rows(task)
    try:
        by_series = regress(rows, task.components)
    except UserError:  # more zeros than the rows of one trim determine
        return by_run, regression
    return (rows, by_series) if _zeros_shift(task, by_run, rows) else (by_run, regression)


def _zeros_shift(task: TrimTask, by_run: TrimRows, by_series: TrimRows) -> bool:
    """Whether the zeros of the load series differ, beyond what curvature and hysteresis explain."""
    directions = loading_directions(by_run)
    fits = []
    for rows in (by_run, by_series):
        columns = np.hstack([rows.uncarried_loads, directions[:, np.any(directions != 0, axis=0)]])
        beside = fit_with_curvature(replace(rows, uncarried_loads=columns), task.components)
        fits.append(beside or regress(rows, task.components))
    return zeros_differ(*fits)


def _regress(task: TrimTask, rows: TrimRows) -> TrimRegression:
    try:
        return regress(rows, task.components)
    except UserError as error:
        raise task.collinear_error(error, rows) from None


def _stack_rows(task: TrimTask) -> TrimRows:
    """The rows of a trim that enter its fit, with a block for each load series, run or segment of one attitude."""
    run = np.repeat(np.arange(len(task.rows)), [len(each.used) for each in task.rows])
    used = np.concatenate([each.used for each in task.rows])
    all_loads = np.vstack([each.loads for each in task.rows])
    components = load_components(task.geometry)
    carried, uncarried = components.from_hub_loads(all_loads), components.remaining_hub_loads(all_loads)
    channels = np.vstack([read_channels(each, task.channel_names) for each in task.runs])
    block = attitude_segments(run, gravity_of_runs(task.runs))
    known = [each.load_series for each in task.rows if each.load_series is not None]
    if len(known) == len(task.rows):
        block = np.concatenate(known)
    block = np.unique(block[used], return_inverse=True)[1].astype(np.intp)
    return TrimRows(channels[used], carried[used], uncarried[used], block, 1.0 / task.noise.relative[run[used]])


def _check_significance(task: TrimTask, rows: TrimRows, regression: TrimRegression) -> None:
    """Raise UserError for a component to which no channel responds significantly."""
    for j, significant in enumerate(significance(regression)):
        if significant < MIN_SIGNIFICANCE:
            fault, remedy = explain_insignificance(rows, task.components, j)
            if fault:
                raise task.error(f"{fault}{task.left_out_note}", remedy)


def _trim_calibration(task: TrimTask, rows: TrimRows, regression: TrimRegression) -> TrimCalibration:
    """Matrices, errors and residuals of a trim from its regression."""
    residual_covariance = add_variance_floor(regression.covariance, rows.channels)
    noise = add_variance_floor(task.noise.covariance, rows.channels)
    ratio = known_lack_of_fit(residual_covariance, regression.dof, noise, task.noise.dof)
    noise_covariance = noise if np.isfinite(ratio) else residual_covariance
    condition = _condition(task, rows, regression, noise_covariance)
    residual_covariance, dof = lack_of_fit_covariance(residual_covariance, regression, rows)
    T0, derivative = inverse_matrix(regression.C0, weight_covariance(residual_covariance, dof))
    return TrimCalibration(
        trim=task.label,
        runs=tuple(run.name for run in task.runs),
        rows=len(rows.loads),
        channel_names=task.channel_names,
        components=task.components,
        C0=regression.C0,
        C0_sigma=standard_errors(regression.C0_covariance),
        C0_covariance=regression.C0_covariance,
        T0=T0,
        T0_sigma=inverse_sigma(derivative, regression.C0_covariance),
        offsets=regression.offsets,
        mean_load=np.average(rows.loads, axis=0, weights=rows.weight),
        mean_channels=_mean_channels(rows, regression),
        residual_covariance=residual_covariance,
        dof=dof,
        noise_covariance=noise_covariance,
        lack_of_fit=ratio,
        calibrated_range=task.calibrated_range,
        channel_rated_range=channel_full_range(
            task.geometry, task.channel_names, regression.C0 * task.calibrated_range
        ),
        residual=_standard_deviation(regression.residuals @ T0.T, rows.weight, regression.dof),
        channel_residual=_standard_deviation(regression.residuals, rows.weight, regression.dof),
        hysteresis=estimate_hysteresis(rows, T0, task.channel_names, task.model),
        condition=condition,
        excluded_channels=task.excluded_channels,
    )


def _mean_channels(rows: TrimRows, regression: TrimRegression) -> Array:
    """Mean reading (c,) [V] of the rows, referred to the mean of the offsets."""
    away = regression.offsets.mean(axis=0) - regression.offsets[rows.run]
    return np.asarray(np.average(rows.channels + away, axis=0, weights=rows.weight))


def _standard_deviation(errors: Array, weight: Array, dof: int) -> Array:
    """Standard deviation (n,) of each column of errors (m, n)."""
    return np.asarray(np.sqrt(weight @ errors**2 / dof))


def _condition(task: TrimTask, rows: TrimRows, regression: TrimRegression, noise_covariance: Array) -> float:
    """Condition of C0, loads in units of the calibrated range, channels in units of their noise.

    Raises UserError where the least singular value is not significant: then a combination of loads has no effect on
    the channels.
    """
    unit = 1.0 / np.sqrt(np.diagonal(noise_covariance))
    U, s, Vt = np.linalg.svd(unit[:, None] * regression.C0 * task.calibrated_range, full_matrices=False)
    u, v = U[:, -1] * unit, Vt[-1] * task.calibrated_range
    condition = float(s[0] / max(s[-1], np.finfo(float).tiny))
    limit = s[-1] / MIN_SINGULAR_VALUE_SIGNIFICANCE
    if condition > LARGEST_CONDITION or not _is_determined(rows, task.components, regression, u, v, limit):
        involved = [
            f"`{name}`" for name, share in zip(task.components, np.abs(Vt[-1]), strict=True) if share > MIN_NULL_SHARE
        ]
        fault = f"the usable channels cannot distinguish {' and '.join(involved)}{task.left_out_note}"
        raise task.error(fault, "Repair the channels, or declare the smaller freedom of the rig or its `components`")
    return condition


def _is_determined(
    rows: TrimRows, components: tuple[str, ...], regression: TrimRegression, u: Array, v: Array, limit: float
) -> bool:
    """Whether the standard error of u' C0 v is within a limit, also where curvature is no error of C0."""

    def sigma(fit: TrimRegression) -> float:
        variance = float(np.einsum("i,j,ijlm,l,m->", u, v, fit.C0_covariance, u, v, optimize=True))
        return float(np.sqrt(max(variance, 0.0)))

    if sigma(regression) < limit:
        return True
    curved = fit_with_curvature(rows, components)
    return curved is not None and sigma(curved) < limit


def channel_full_range(geometry: Geometry, channel_names: Sequence[str], C: Array) -> Array:
    """Rated range (c,) [V] of each channel: that of its cell; otherwise the largest reading at calibrated range.

    C (c, k) [V]: response to each component at its calibrated range.
    """
    cells = {cell.name: cell.full_range for cell in geometry.cells}
    channels = {channel.name: channel for channel in geometry.channels}
    calibrated = dict(zip(channel_names, np.max(np.abs(C), axis=1).tolist(), strict=True))
    return np.array(
        [
            calibrated[name]
            if channels[name].cell is None
            else abs(channels[name].sensitivity) * cells[str(channels[name].cell)]
            for name in channel_names
        ]
    )
