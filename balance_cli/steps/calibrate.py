"""The step `calibrate`: static runs to the matrices C0 and T0, one set for each trim."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import Calibration, Hysteresis, TrimCalibration
from balance_cli.calibration.static_matrices import (
    TrimRegression,
    TrimRows,
    add_variance_floor,
    hysteresis,
    inverse_matrix,
    inverse_sigma,
    lack_of_fit,
    regress,
    significance,
    standard_errors,
)
from balance_cli.campaign.recording.channel_health import live_channels
from balance_cli.campaign.recording.run import Run, read_channels
from balance_cli.campaign.rig.attitude import attitude_segments
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.model.plate import carried_components
from balance_cli.signals.static_noise import static_points
from balance_cli.steps.calibrate_all_trims import fit_all_trims, gravity

Array = NDArray[np.float64]

MIN_SIGNIFICANCE = 25.0
MIN_LOAD_VARIATION = 0.01
MIN_SINGULAR_VALUE_SIGNIFICANCE = 5.0  # standard errors by which the least singular value of C0 must differ from zero
LARGEST_CONDITION = 1e8


@dataclass(frozen=True)
class _TrimTask:
    """One trim to be calibrated: its runs, usable channels, carried components and their full range (k,)."""

    label: str
    runs: tuple[Run, ...]
    geometry: Geometry
    channel_names: tuple[str, ...]
    left_out: dict[str, str]
    components: tuple[str, ...]
    full_range: Array

    def error(self, fault: str, remedy: str) -> UserError:
        """What is wrong with this trim."""
        return UserError(fault, ", ".join(_place(run) for run in self.runs), f"trim {self.label}", remedy)

    @property
    def left_out_note(self) -> str:
        """The channels left out, for a message."""
        lost = ", ".join(f"{name}: {reason}" for name, reason in self.left_out.items())
        return f" (left out: {lost})" if lost else ""


@dataclass(frozen=True)
class _RowNoise:
    """Noise of a row: covariance (c, c), its degrees of freedom (0: not told by the rows), relative size by run."""

    covariance: Array
    dof: float
    relative: Array


def calibrate(
    runs: Iterable[Run], geometry: Geometry, search: bool = True, hold_out: Sequence[Run] = (), direct: bool = False
) -> Calibration:
    """C0 and T0 for each trim, from the static runs among `runs`; runs of one trim are taken together.

    One gage model goes through all trims: the loads alone, or with `search` the terms that the channels have. The
    static runs of `hold_out` take no part and check it; with `direct` the loads as functions of the readings come
    beside it. Full range of a component is the largest load applied to it in all runs.

    Raises UserError where there is no static run, a run has no loads, a trim does not load a component that the
    geometry's freedom carries, or the channels that can be used do not determine the loads.
    """
    static = [run for run in runs if run.kind == "static"]
    if not static:
        raise UserError("there is no static run among the runs", remedy="Give the static runs of the calibration")
    for run in static:
        if not run.has_loads:
            raise UserError("a static run without loads", _place(run), "loads", "Record the applied loads")
    components = carried_components(geometry)
    loads_range = np.max([np.max(np.abs(_loads_of_run(run)), axis=0) for run in static], axis=0)
    full_range = loads_range[[COMPONENTS.index(name) for name in components]]
    trims = {}
    for label in dict.fromkeys(run.trim or "" for run in static):
        members = tuple(run for run in static if (run.trim or "") == label)
        names, left_out = _usable_channels(members, geometry)
        trims[label] = _calibrate_trim(_TrimTask(label, members, geometry, names, left_out, components, full_range))
    return Calibration(geometry, trims, fit_all_trims(static, geometry, trims, hold_out, search, direct))


def _calibrate_trim(task: _TrimTask) -> TrimCalibration:
    """Calibration about one trim. UserError as for `calibrate`."""
    c, k = len(task.channel_names), len(task.components)
    if c < k:
        fault = f"{c} usable channels cannot determine {k} load components{task.left_out_note}"
        raise task.error(fault, "Repair the channels, or declare the smaller freedom of the rig")
    noise = _pooled_noise(task)
    rows = _stack_rows(task, noise)
    _check_loaded(task, rows)
    try:
        regression = regress(rows, task.components)
    except UserError as error:
        raise task.error(error.fault, error.remedy) from None
    _check_significance(task, regression)
    return _trim_calibration(task, rows, regression, noise)


def _place(run: Run) -> str:
    return str(run.path or f"run {run.name}")


def _loads_of_run(run: Run) -> Array:
    loads = run.read().loads
    assert loads is not None
    return loads


def _usable_channels(runs: Sequence[Run], geometry: Geometry) -> tuple[tuple[str, ...], dict[str, str]]:
    """Channels that pass a constant load and are sound in every run, and the others of these with the reason."""
    left_out: dict[str, str] = {}
    for run in runs:
        for name, reason in live_channels(run, geometry).left_out.items():
            left_out.setdefault(name, f"{reason} (run {run.name})" if len(runs) > 1 else reason)
    constant = [channel.name for channel in geometry.channels if channel.measures_dc]
    return tuple(name for name in constant if name not in left_out), {
        name: reason for name, reason in left_out.items() if name in constant
    }


def _pooled_noise(task: _TrimTask) -> _RowNoise:
    """Noise of a row from the differences of neighbours, pooled over the runs whose rows tell it."""
    measured = []
    for run in task.runs:
        try:
            points = static_points(run, task.channel_names)
        except UserError:  # rows in no order, or too few: the residual of the regression has to serve
            c = len(task.channel_names)
            return _RowNoise(np.zeros((c, c)), 0.0, np.ones(len(task.runs)))
        measured.append((points.covariance, points.dof))
    dof = sum(each for _, each in measured)
    pooled = np.asarray(sum(covariance * each for covariance, each in measured) / dof)
    relative = [float(np.mean(np.diagonal(covariance) / np.diagonal(pooled))) for covariance, _ in measured]
    return _RowNoise(pooled, dof, np.array(relative))


def _stack_rows(task: _TrimTask, noise: _RowNoise) -> TrimRows:
    loads = [_loads_of_run(run) for run in task.runs]
    of_run = np.repeat(np.arange(len(loads)), [len(each) for each in loads])
    together = np.vstack(loads)
    carried = [COMPONENTS.index(name) for name in task.components]
    other = [j for j in range(len(COMPONENTS)) if j not in carried and np.ptp(together[:, j]) > 0]
    channels = np.vstack([read_channels(run, task.channel_names) for run in task.runs])
    offset = attitude_segments(of_run, gravity(task.runs))
    return TrimRows(channels, together[:, carried], together[:, other], offset, 1.0 / noise.relative[of_run])


def _check_loaded(task: _TrimTask, rows: TrimRows) -> None:
    """UserError for a component whose load did not change."""
    spread, size = np.ptp(rows.loads, axis=0), np.max(np.abs(rows.loads), axis=0)
    for name, varied in zip(task.components, spread > MIN_LOAD_VARIATION * size, strict=True):
        if not varied:
            raise task.error(f"`{name}` was never loaded", f"Apply `{name}` in steps about this trim")


def _check_significance(task: _TrimTask, regression: TrimRegression) -> None:
    """UserError for a component whose load no channel shows."""
    for name, significant in zip(task.components, significance(regression), strict=True):
        if significant < MIN_SIGNIFICANCE:
            fault = f"`{name}` was hardly loaded, or no usable channel shows it{task.left_out_note}"
            raise task.error(fault, f"Apply `{name}` in steps, and check the channels that should show it")


def _trim_calibration(task: _TrimTask, rows: TrimRows, regression: TrimRegression, noise: _RowNoise) -> TrimCalibration:
    """Everything that follows from the regression."""
    residual_covariance = add_variance_floor(regression.covariance, rows.channels)
    noise_covariance = add_variance_floor(noise.covariance, rows.channels) if noise.dof else residual_covariance
    condition = _condition(task, regression, noise_covariance)
    T0, derivative = inverse_matrix(regression.C0, residual_covariance)
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
        mean_channels=_mean_channels(task, rows, regression),
        residual_covariance=residual_covariance,
        dof=regression.dof,
        noise_covariance=noise_covariance,
        lack_of_fit=lack_of_fit(residual_covariance, noise_covariance, noise.dof),
        full_range=task.full_range,
        channel_full_range=channel_full_range(task.geometry, task.channel_names, task.components, task.full_range),
        residual=_standard_deviation(regression.residuals @ T0.T, rows.weight, regression.dof),
        channel_residual=_standard_deviation(regression.residuals, rows.weight, regression.dof),
        hysteresis=Hysteresis(*hysteresis(rows, T0)),
        condition=condition,
        left_out=task.left_out,
    )


def _mean_channels(task: _TrimTask, rows: TrimRows, regression: TrimRegression) -> Array:
    """Mean reading (c,) of the rows; where attitudes are stated, as if all rows were read with the mean offset."""
    away = np.zeros_like(rows.channels)
    if gravity(task.runs) is not None:
        away = regression.offsets.mean(axis=0) - regression.offsets[rows.run]
    return np.asarray(np.average(rows.channels + away, axis=0, weights=rows.weight))


def _standard_deviation(errors: Array, weight: Array, dof: int) -> Array:
    """Standard deviation of each column of errors (m, n) about the line."""
    return np.asarray(np.sqrt(weight @ errors**2 / dof))


def _condition(task: _TrimTask, regression: TrimRegression, noise_covariance: Array) -> float:
    """Condition of C0, loads in units of full range, channels of their noise.

    UserError where the least singular value is not told from zero: then some loads together leave no trace.
    """
    unit = 1.0 / np.sqrt(np.diagonal(noise_covariance))
    U, s, Vt = np.linalg.svd(unit[:, None] * regression.C0 * task.full_range, full_matrices=False)
    u, v = U[:, -1] * unit, Vt[-1] * task.full_range
    variance = float(np.einsum("i,j,ijlm,l,m->", u, v, regression.C0_covariance, u, v, optimize=True))
    condition = float(s[0] / max(s[-1], np.finfo(float).tiny))
    if s[-1] < MIN_SINGULAR_VALUE_SIGNIFICANCE * np.sqrt(max(variance, 0.0)) or condition > LARGEST_CONDITION:
        involved = [f"`{name}`" for name, share in zip(task.components, np.abs(Vt[-1]), strict=True) if share > 0.1]
        fault = f"the usable channels do not tell {' and '.join(involved)} apart{task.left_out_note}"
        raise task.error(fault, "Repair the channels, or declare the smaller freedom of the rig")
    return condition


def channel_full_range(
    geometry: Geometry, channel_names: Sequence[str], components: Sequence[str], full_range: Array
) -> Array:
    """Full range (c,) of each channel [V]: that of its cell; of a torque meter the range (k,) that was applied."""
    torque = dict(zip(components, full_range.tolist(), strict=True)).get("Mz", 1.0)
    cells = {cell.name: cell.full_range for cell in geometry.cells}
    declared = {
        channel.name: abs(channel.sensitivity) * (torque if channel.cell is None else cells[channel.cell])
        for channel in geometry.channels
    }
    return np.array([declared[name] for name in channel_names])
