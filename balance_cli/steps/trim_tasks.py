"""Tasks of a calibration: for each trim the rows, the usable channels and the calibrated range."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.all_trims_result import AllTrimsCalibration
from balance_cli.calibration.contradicted_block import UNDECIDED
from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.static_matrices import TrimRows
from balance_cli.campaign.recording.channel_health import live_channels
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.load_components import LoadComponents
from balance_cli.io.errors import UserError
from balance_cli.steps.calibrate_all_trims import AllTrimRows
from balance_cli.steps.load_point_rows import LoadPointRows, RowNoise, measure_row_noise

Array = NDArray[np.float64]

MIN_LOAD_VARIATION = 0.01
"""Variation of a load over its largest value below which it counts as constant: above load noise, below any step."""
MOST_PLACES = 3
"""Files that an error names; it is a line, and a trim may have hundreds."""


@dataclass(frozen=True)
class TrimTask:
    """One trim to be calibrated: its rows, usable channels, carried components and their calibrated range (k,).

    `noise` of a row, with that of each run; `model`: that which computes the loads, of all trims, where there is one.
    """

    label: str
    rows: tuple[LoadPointRows, ...]
    geometry: Geometry
    channel_names: tuple[str, ...]
    excluded_channels: dict[str, str]
    components: tuple[str, ...]
    calibrated_range: Array
    noise: RowNoise
    model: CalibrationModel | None = None

    @property
    def runs(self) -> tuple[Run, ...]:
        """The runs of the trim."""
        return tuple(rows.run for rows in self.rows)

    def error(self, fault: str, remedy: str) -> UserError:
        """The error to raise for a fault of this trim."""
        places = list(dict.fromkeys(run_place(run) for run in self.runs))
        more = [f"{len(places) - MOST_PLACES} more"] if len(places) > MOST_PLACES else []
        return UserError(fault, ", ".join([*places[:MOST_PLACES], *more]), f"trim {self.label}", remedy)

    def collinear_error(self, error: UserError, rows: TrimRows) -> UserError:
        """The error to raise for loads that the rows do not determine."""
        numbers = range(int(rows.run.max()) + 1)
        if len(numbers) > 1 and not any(np.any(np.ptp(rows.loads[rows.run == k], axis=0)) for k in numbers):
            fault = f"each of {len(numbers)} runs has one load and a zero of its own, which takes up all of it"
            return self.error(fault, "Put the loads that were applied in succession into one run or table")
        return self.error(error.fault, error.remedy)

    @property
    def left_out_note(self) -> str:
        """The excluded channels, as part of a message."""
        lost = ", ".join(f"{name}: {reason}" for name, reason in self.excluded_channels.items())
        return f" (left out: {lost})" if lost else ""


def trim_tasks(rows: Sequence[LoadPointRows], geometry: Geometry, components: LoadComponents) -> dict[str, TrimTask]:
    """One task for each trim label, in the order of the runs."""
    loads = [components.from_hub_loads(each.loads[each.used]) for each in rows]
    calibrated_range = np.asarray(np.max(np.abs(np.vstack(loads)), axis=0, initial=0.0))
    tasks = {}
    for label in dict.fromkeys(each.run.trim or "" for each in rows):
        members = tuple(each for each in rows if (each.run.trim or "") == label)
        names, excluded = _usable_channels([each.run for each in members], geometry)
        noise = measure_row_noise(members, names)
        tasks[label] = TrimTask(label, members, geometry, names, excluded, components.names, calibrated_range, noise)
    return tasks


def rows_of_tasks(static: Sequence[Run], tasks: Mapping[str, TrimTask]) -> AllTrimRows:
    """The rows of all trims in the order of the runs, with what the fit of all trims needs of each."""
    by_run = {
        rows.run.name: (rows, float(relative))
        for task in tasks.values()
        for rows, relative in zip(task.rows, task.noise.relative, strict=True)
    }
    first = next(iter(tasks.values()))
    common = [task.channel_names for task in tasks.values()]
    return AllTrimRows(
        rows=tuple(by_run[run.name][0] for run in static),
        relative_noise=tuple(by_run[run.name][1] for run in static),
        channel_names=tuple(name for name in first.channel_names if all(name in names for names in common)),
        calibrated_range=first.calibrated_range,
    )


def fitted_tasks(
    static: Sequence[Run], tasks: Mapping[str, TrimTask], all_trims: AllTrimsCalibration | None
) -> dict[str, TrimTask]:
    """The tasks with the rows, load series and calibrated range of the model of all trims."""
    if all_trims is None or all_trims.load_series is None:
        return dict(tasks)
    excluded = np.asarray(~np.isfinite(all_trims.residuals).all(axis=1))
    at = {run.name: all_trims.run == number for number, run in enumerate(static)}
    series = all_trims.load_series
    return {
        label: replace(
            task,
            rows=tuple(rows.exclude_rows(excluded[at[rows.run.name]], series[at[rows.run.name]]) for rows in task.rows),
            calibrated_range=all_trims.model.calibrated_range,
            model=all_trims.loads_model,
        )
        for label, task in tasks.items()
    }


def run_place(run: Run) -> str:
    """Where a run is, for messages."""
    return str(run.path or f"run {run.name}")


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


def check_attitudes(runs: Sequence[Run], components: LoadComponents) -> None:
    """Raise UserError for attitudes with components of the user's own: the weight is computed for hub loads only."""
    for run in runs:
        if run.attitude is not None and not components.are_hub_loads:
            fault = f"states attitudes, but the components are {', '.join(components.names)}"
            raise UserError(fault, run_place(run), "attitude", "Declare Fx to Mz as `components` of the geometry")


def with_contradiction(error: UserError, all_trims: AllTrimsCalibration | None) -> UserError:
    """Return the error of a trim with what contradicts in its rows, where the model of all trims says that."""
    notes = () if all_trims is None else all_trims.screening_notes
    note = next((note for note in notes if note.endswith(UNDECIDED)), "")
    return UserError(f"{error.fault}; {note}", error.file, error.place, error.remedy) if note else error


def check_loaded(task: TrimTask, rows: TrimRows) -> None:
    """Raise UserError for a component whose load did not change."""
    spread, size = np.ptp(rows.loads, axis=0), np.max(np.abs(rows.loads), axis=0)
    for name, varied in zip(task.components, spread > MIN_LOAD_VARIATION * size, strict=True):
        if not varied:
            remedy = f"Apply `{name}` in steps about this trim, or leave it out of the `components` in the geometry"
            raise task.error(f"`{name}` was never loaded", remedy)
