"""The calibration model of a calibration from its static runs, through all trims."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.all_trims import calibrate_all_trims, read_load_points
from balance_cli.calibration.all_trims_result import AllTrimsCalibration
from balance_cli.calibration.check_loads import HeldOutRun
from balance_cli.calibration.fit import CalibrationPoints
from balance_cli.calibration.least_squares import CollinearError
from balance_cli.calibration.term_choice import TermChoice
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.attitude import gravity_directions
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_checks import missing_mechanics
from balance_cli.campaign.rig.load_components import LoadComponents, load_components
from balance_cli.io.errors import UserError
from balance_cli.model.balance import balance_model
from balance_cli.model.system_response import response, solve
from balance_cli.steps.load_point_rows import LoadPointRows, repeat_scatter

Array = NDArray[np.float64]


@dataclass(frozen=True)
class AllTrimRows:
    """Rows of the static runs of all trims, with the noise variance of each run over that of its trim.

    `channel_names`: channels that are usable in all trims. `calibrated_range` (k,) [N, N m] of the applied loads.
    """

    rows: tuple[LoadPointRows, ...]
    relative_noise: tuple[float, ...]
    channel_names: tuple[str, ...]
    calibrated_range: Array


def fit_all_trims(
    members: AllTrimRows,
    geometry: Geometry,
    hold_out: Sequence[Run],
    choice: TermChoice,
    non_iterative: bool,
) -> AllTrimsCalibration | None:
    """Fit one calibration model to the runs of all trims.

    Returns None where the channels that the trims have in common do not determine the loads, loads were applied that
    the balance does not carry, or a load was never applied separately within a load series.

    Raises UserError for a hold-out run without some of the channels.
    """
    names, components = members.channel_names, load_components(geometry)
    runs = [rows.run for rows in members.rows]
    if len(names) < len(components.names) or any(_has_uncarried_loads(run, components) for run in runs):
        return None
    units = {channel.name: channel.reading_unit for channel in geometry.channels}
    points = stack_points(members, components)
    points = replace(
        points,
        reading_units=tuple(units[name] for name in names),
        declared_response=_declared_response(geometry, names),
        plate_response=plate_response(geometry, names),
        repeat_scatter=repeat_scatter(members.rows, names),
        check_points=np.concatenate([rows.is_check for rows in members.rows]),
    )
    for run in hold_out:
        _check_hold_out_channels(run, names)
    gravity = _gravity_by_run(hold_out)
    held_out = [
        HeldOutRun(run.name, *read_load_points(run, names, components), gravity.get(run.name)) for run in hold_out
    ]
    try:
        return calibrate_all_trims(points, held_out, choice, non_iterative)
    except CollinearError:
        return None


def stack_points(members: AllTrimRows, components: LoadComponents) -> CalibrationPoints:
    """All rows of the static runs, those that enter no fit with weight 0."""
    runs = [rows.run for rows in members.rows]
    read = [read_load_points(run, members.channel_names, components) for run in runs]
    run = np.repeat(np.arange(len(runs)), [len(loads) for _, loads in read])
    used = np.concatenate([rows.used for rows in members.rows])
    return CalibrationPoints(
        channel_names=members.channel_names,
        components=components.names,
        run_names=tuple(run.name for run in runs),
        channels=np.vstack([channels for channels, _ in read]),
        loads=np.vstack([loads for _, loads in read]),
        run=run,
        weight=np.where(used, 1.0 / np.array(members.relative_noise)[run], 0.0),
        calibrated_range=members.calibrated_range,
        gravity=gravity_of_runs(runs),
        stated_series=tuple(label for rows in members.rows for label in rows.stated_series),
        tare_points=np.concatenate([rows.tare_points for rows in members.rows]),
    )


def gravity_of_runs(runs: Sequence[Run]) -> Array | None:
    """Directions of gravity (m, 3) in all rows, NaN for runs that do not state an attitude; None where no run does."""
    known = _gravity_by_run(runs)
    return np.vstack([known.get(run.name, np.full((run.samples, 3), np.nan)) for run in runs]) if known else None


def _gravity_by_run(runs: Sequence[Run]) -> dict[str, Array]:
    return {run.name: gravity_directions(run.attitude) for run in runs if run.attitude is not None}


def _declared_response(geometry: Geometry, channel_names: Sequence[str]) -> Array | None:
    """Static response (c, k) [V/N, V/(N m)] of the declared rig; None where its mechanics are not declared."""
    if missing_mechanics(geometry):
        return None
    system = balance_model(geometry).system()
    T = response(system, solve(system, np.zeros(1)))[0].real
    rows = [geometry.channel_names.index(name) for name in channel_names]
    return np.asarray(T[rows] @ load_components(geometry).to_hub.T)


def plate_response(geometry: Geometry, channel_names: Sequence[str]) -> Array | None:
    """Response (c, k) [V/(N m)] to a moment on the plate about each shaft with a torque meter, NaN elsewhere.

    The meters do not read it. The cells read it as the moment of the hub where the plate carries the drive (NaN), and
    else as those of the declared plate without a shaft: not at all, where the plate cannot turn about it. None without
    a shaft, or where the mechanics are not declared.
    """
    shaft = {meter.component: meter.carried_by for meter in geometry.shaft_meters}
    components = load_components(geometry).names
    if missing_mechanics(geometry) or not shaft.keys() & set(components):
        return None
    of_meter = [channel.name for channel in geometry.channels if channel.torque_meter]
    cells = [name for name in channel_names if name not in of_meter]
    rest = tuple(channel for channel in geometry.channels if not channel.torque_meter)
    plate = geometry.model_copy(update={"torque_meter": None, "torque_meters": None, "channels": rest})
    declared, of_plate = _declared_response(plate, cells), load_components(plate).names
    result = np.full((len(channel_names), len(components)), np.nan)
    for name in shaft.keys() & set(components):
        j = components.index(name)
        result[[channel_names.index(meter) for meter in of_meter if meter in channel_names], j] = 0.0
        if shaft[name] == "ground" and declared is not None:
            read = declared[:, of_plate.index(name)] if name in of_plate else 0.0
            result[[channel_names.index(cell) for cell in cells], j] = read
    return result


def _check_hold_out_channels(run: Run, names: tuple[str, ...]) -> None:
    """Raise UserError for a hold-out run that lacks a channel of the calibration."""
    lost = [name for name in names if name not in run.channel_names]
    if lost:
        fault = f"the hold-out run has no channel {', '.join(lost)}"
        raise UserError(
            fault, str(run.path or f"run {run.name}"), "channels", "Hold out a run with all channels of the calibration"
        )


def _has_uncarried_loads(run: Run, components: LoadComponents) -> bool:
    """Whether a load was applied that the balance does not carry."""
    loads = run.read().loads
    assert loads is not None
    return bool(components.remaining_hub_loads(loads).shape[1])
