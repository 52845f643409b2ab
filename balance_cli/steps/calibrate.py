"""The step `calibrate`: from static runs to the matrices C0 and T0 of each trim and the model of all trims."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import Calibration, Hysteresis, TrimCalibration, with_rated_loads
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
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.load_components import LoadComponents, load_components
from balance_cli.io.errors import UserError
from balance_cli.signals.static_noise import static_points
from balance_cli.steps.calibrate_all_trims import fit_all_trims, gravity_of_runs

Array = NDArray[np.float64]

MIN_SIGNIFICANCE = 25.0
"""Mean squared t of a component's coefficients (5 sigma) below which it counts as hardly loaded."""
MIN_LOAD_VARIATION = 0.01
"""Variation of a load over its largest value below which it counts as constant: above load noise, below any step."""
MIN_SINGULAR_VALUE_SIGNIFICANCE = 5.0
"""Standard errors by which the least singular value of C0 must differ from zero for it to determine the loads."""
LARGEST_CONDITION = 1e8
"""Condition of C0 from which it does not determine the loads: half the digits of double precision."""
MIN_NULL_SHARE = 0.1
"""Share in the least singular vector from which a component is named in an error."""


@dataclass(frozen=True)
class _TrimTask:
    """One trim to be calibrated: runs, usable channels, carried components and their calibrated range (k,) [N, N m]."""

    label: str
    runs: tuple[Run, ...]
    geometry: Geometry
    channel_names: tuple[str, ...]
    excluded_channels: dict[str, str]
    components: tuple[str, ...]
    calibrated_range: Array

    def error(self, fault: str, remedy: str) -> UserError:
        """The error to raise for a fault of this trim."""
        return UserError(fault, ", ".join(_place(run) for run in self.runs), f"trim {self.label}", remedy)

    @property
    def left_out_note(self) -> str:
        """The excluded channels, as part of a message."""
        lost = ", ".join(f"{name}: {reason}" for name, reason in self.excluded_channels.items())
        return f" (left out: {lost})" if lost else ""


@dataclass(frozen=True)
class _RowNoise:
    """Noise of a row: covariance (c, c) [V2], degrees of freedom (0 if unknown), and relative variance of each run."""

    covariance: Array
    dof: float
    relative: Array


def calibrate(
    runs: Iterable[Run],
    geometry: Geometry,
    search: bool = True,
    hold_out: Sequence[Run] = (),
    non_iterative: bool = False,
) -> Calibration:
    """Calibrate from the static runs among `runs`: C0 and T0 for each trim, and one model of all trims.

    The model has the loads alone, or with `search` the terms selected for each channel. The static runs of `hold_out`
    are not fitted, but check the model. With `non_iterative` the loads are also fitted as functions of the readings.
    The calibrated range of a component is the largest load applied to it in all runs.

    Raises UserError where there is no static run, a run has no loads, a trim does not load a component that the balance
    carries, or the usable channels do not determine the loads.
    """
    static = [run for run in runs if run.kind == "static"]
    if not static:
        raise UserError("there is no static run among the runs", remedy="Give the static runs of the calibration")
    for run in static:
        if not run.has_loads:
            raise UserError("a static run without loads", _place(run), "loads", "Record the applied loads")
    components = load_components(geometry)
    _check_attitudes(static, components)
    loads = [components.carried(_loads_of_run(run)) for run in static]
    calibrated_range = np.max([np.max(np.abs(run_loads), axis=0) for run_loads in loads], axis=0)
    trims = {}
    for label in dict.fromkeys(run.trim or "" for run in static):
        members = tuple(run for run in static if (run.trim or "") == label)
        names, excluded = _usable_channels(members, geometry)
        task = _TrimTask(label, members, geometry, names, excluded, components.names, calibrated_range)
        trims[label] = with_rated_loads(_calibrate_trim(task), geometry)
    return Calibration(geometry, trims, fit_all_trims(static, geometry, trims, hold_out, search, non_iterative))


def _check_attitudes(runs: Sequence[Run], components: LoadComponents) -> None:
    """Raise UserError for attitudes with components of the user's own: the weight is computed for hub loads only."""
    for run in runs:
        if run.attitude is not None and not components.are_hub_loads:
            fault = f"states attitudes, but the components are {', '.join(components.names)}"
            raise UserError(fault, _place(run), "attitude", "Declare Fx to Mz as `components` of the geometry")


def _calibrate_trim(task: _TrimTask) -> TrimCalibration:
    """Calibrate one trim; raises UserError as `calibrate` does."""
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
    """Channels that measure constant loads and are live in every run, and the unusable ones with the reason."""
    left_out: dict[str, str] = {}
    for run in runs:
        for name, reason in live_channels(run, geometry).left_out.items():
            left_out.setdefault(name, f"{reason} (run {run.name})" if len(runs) > 1 else reason)
    constant = [channel.name for channel in geometry.channels if channel.measures_dc]
    return tuple(name for name in constant if name not in left_out), {
        name: reason for name, reason in left_out.items() if name in constant
    }


def _pooled_noise(task: _TrimTask) -> _RowNoise:
    """Noise of a row from differences of neighboring rows, pooled over the runs."""
    measured = []
    for run in task.runs:
        try:
            points = static_points(run, task.channel_names)
        except UserError:  # too few rows in a ramp: the residuals of the regression are used instead
            c = len(task.channel_names)
            return _RowNoise(np.zeros((c, c)), 0.0, np.ones(len(task.runs)))
        measured.append((points.covariance, points.dof))
    dof = sum(each for _, each in measured)
    pooled = np.asarray(sum(covariance * each for covariance, each in measured) / dof)
    relative = [float(np.mean(np.diagonal(covariance) / np.diagonal(pooled))) for covariance, _ in measured]
    return _RowNoise(pooled, dof, np.array(relative))


def _stack_rows(task: _TrimTask, noise: _RowNoise) -> TrimRows:
    loads = [_loads_of_run(run) for run in task.runs]
    run = np.repeat(np.arange(len(loads)), [len(run_loads) for run_loads in loads])
    all_loads = np.vstack(loads)
    components = load_components(task.geometry)
    carried, uncarried = components.carried(all_loads), components.uncarried(all_loads)
    channels = np.vstack([read_channels(run, task.channel_names) for run in task.runs])
    offset = attitude_segments(run, gravity_of_runs(task.runs))
    return TrimRows(channels, carried, uncarried, offset, 1.0 / noise.relative[run])


def _check_loaded(task: _TrimTask, rows: TrimRows) -> None:
    """Raise UserError for a component whose load did not change."""
    spread, size = np.ptp(rows.loads, axis=0), np.max(np.abs(rows.loads), axis=0)
    for name, varied in zip(task.components, spread > MIN_LOAD_VARIATION * size, strict=True):
        if not varied:
            raise task.error(f"`{name}` was never loaded", f"Apply `{name}` in steps about this trim")


def _check_significance(task: _TrimTask, regression: TrimRegression) -> None:
    """Raise UserError for a component to which no channel responds significantly."""
    for name, significant in zip(task.components, significance(regression), strict=True):
        if significant < MIN_SIGNIFICANCE:
            fault = f"`{name}` was hardly loaded, or no usable channel shows it{task.left_out_note}"
            raise task.error(fault, f"Apply `{name}` in steps, and check the channels that should show it")


def _trim_calibration(task: _TrimTask, rows: TrimRows, regression: TrimRegression, noise: _RowNoise) -> TrimCalibration:
    """Matrices, errors and residuals of a trim from its regression."""
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
        calibrated_range=task.calibrated_range,
        channel_rated_range=channel_full_range(
            task.geometry, task.channel_names, regression.C0 * task.calibrated_range
        ),
        residual=_standard_deviation(regression.residuals @ T0.T, rows.weight, regression.dof),
        channel_residual=_standard_deviation(regression.residuals, rows.weight, regression.dof),
        hysteresis=Hysteresis(*hysteresis(rows, T0)),
        condition=condition,
        excluded_channels=task.excluded_channels,
    )


def _mean_channels(task: _TrimTask, rows: TrimRows, regression: TrimRegression) -> Array:
    """Mean reading (c,) [V] of the rows; where attitudes are stated, referred to the mean offset."""
    away = np.zeros_like(rows.channels)
    if gravity_of_runs(task.runs) is not None:
        away = regression.offsets.mean(axis=0) - regression.offsets[rows.run]
    return np.asarray(np.average(rows.channels + away, axis=0, weights=rows.weight))


def _standard_deviation(errors: Array, weight: Array, dof: int) -> Array:
    """Standard deviation (n,) of each column of errors (m, n)."""
    return np.asarray(np.sqrt(weight @ errors**2 / dof))


def _condition(task: _TrimTask, regression: TrimRegression, noise_covariance: Array) -> float:
    """Condition of C0, loads in units of the calibrated range, channels in units of their noise.

    Raises UserError where the least singular value is not significant: then a combination of loads has no effect on
    the channels.
    """
    unit = 1.0 / np.sqrt(np.diagonal(noise_covariance))
    U, s, Vt = np.linalg.svd(unit[:, None] * regression.C0 * task.calibrated_range, full_matrices=False)
    u, v = U[:, -1] * unit, Vt[-1] * task.calibrated_range
    variance = float(np.einsum("i,j,ijlm,l,m->", u, v, regression.C0_covariance, u, v, optimize=True))
    condition = float(s[0] / max(s[-1], np.finfo(float).tiny))
    if s[-1] < MIN_SINGULAR_VALUE_SIGNIFICANCE * np.sqrt(max(variance, 0.0)) or condition > LARGEST_CONDITION:
        involved = [
            f"`{name}`" for name, share in zip(task.components, np.abs(Vt[-1]), strict=True) if share > MIN_NULL_SHARE
        ]
        fault = f"the usable channels cannot distinguish {' and '.join(involved)}{task.left_out_note}"
        raise task.error(fault, "Repair the channels, or declare the smaller freedom of the rig")
    return condition


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
