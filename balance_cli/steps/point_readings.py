"""Rows of a point table or static run as readings for `apply`: which rows share a zero, and which are one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.load_series import find_load_series
from balance_cli.calibration.result import Calibration
from balance_cli.campaign.recording.load_table import LoadTable
from balance_cli.campaign.recording.run import Run, pick_channels
from balance_cli.campaign.recording.temperature import run_temperature
from balance_cli.campaign.rig.attitude import gravity_directions, is_one_direction
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.load_components import load_components
from balance_cli.io.errors import UserError
from balance_cli.steps.point_zeros import PointReadings, ZeroReading

Array = NDArray[np.float64]
Index = NDArray[np.intp]

TARE = "tare"


def point_readings(table: LoadTable, calibration: Calibration, first_is_zero: bool) -> PointReadings:
    """The rows of a table; those of one run and load series share a zero.

    With `first_is_zero` the first row of each run is that of the unloaded balance, otherwise the rows of kind `tare`.
    """
    n = len(table.lines)
    runs, series = row_runs(table), table.labels.get("series", ("",) * n)
    keys = list(zip(runs, ("",) * n if first_is_zero else series, strict=True))
    numbers = {key: number for number, key in enumerate(dict.fromkeys(keys))}
    group = np.array([numbers[key] for key in keys], np.intp)
    if first_is_zero:
        is_zero = np.isin(np.arange(n), np.unique(group, return_index=True)[1])
    else:
        is_zero = np.array([kind == TARE for kind in table.labels.get("point", ("",) * n)])
    loads = None if table.hub_loads is None else load_components(calibration.geometry).from_hub_loads(table.hub_loads)
    return PointReadings(
        run=table.path.stem,
        channel_names=table.channel_names,
        channels=table.channels,
        zero_group=group,
        is_zero=is_zero,
        applied=loads,
        temperature=table.temperature,
        gravity=None if table.attitude is None else gravity_directions(table.attitude),
        load_series=_load_series(runs, series, loads) if first_is_zero else None,
    )


def _load_series(runs: tuple[str, ...], series: tuple[str, ...], loads: Array | None) -> Index | None:
    """Number (n,) of the load series of each row: as stated or, for known loads (n, k), as these tell; else None."""
    run = np.unique(runs, return_inverse=True)[1].astype(np.intp)
    if all(series):
        return np.unique([f"{name} {label}" for name, label in zip(run, series, strict=True)], return_inverse=True)[1]
    if loads is None or not np.any(loads):
        return None
    load_series = find_load_series(loads / np.maximum(np.max(np.abs(loads), axis=0), np.finfo(float).tiny), run)
    return _part_tares_between(np.asarray(load_series, np.intp), ~np.any(loads, axis=1))


def _part_tares_between(series: Index, unloaded: NDArray[np.bool_]) -> Index:
    """The series (n,), with a number of its own for an unloaded row between two: it may open the later one."""
    parted = series.copy()
    opens = np.flatnonzero(np.diff(series) != 0) + 1
    for row in opens.tolist():
        for between in (row - 1, row):
            if unloaded[between]:
                parted[between] = parted.max() + 1
    return parted


def row_runs(table: LoadTable) -> tuple[str, ...]:
    """Name (n,) of the run of each row."""
    return table.labels.get("run", (table.path.stem,) * len(table.lines))


def zero_reading(table: LoadTable) -> ZeroReading:
    """Mean reading of a table of the unloaded balance: of its rows of kind `tare`, of all rows where it names none.

    Raises UserError for loads in these rows.
    """
    kinds = table.labels.get("point", (TARE,) * len(table.lines))
    rows = np.array([kind == TARE for kind in kinds])
    rows = rows if rows.any() else np.ones_like(rows)
    if table.hub_loads is not None and np.any(table.hub_loads[rows]):
        fault = "has loads: it is no reading of the unloaded balance"
        raise UserError(fault, str(table.path), remedy="Give a table of unloaded rows, or mark them as `tare`")
    temperature = None if table.temperature is None else float(table.temperature[rows].mean())
    gravity = None if table.attitude is None else gravity_directions(table.attitude[rows])
    if gravity is not None and not is_one_direction(gravity):
        fault = "was read in several attitudes: its mean is the reading of none"
        raise UserError(
            fault, str(table.path), "--zero", "Give unloaded rows in one attitude, or mark them in the table"
        )
    return ZeroReading(
        channel_names=table.channel_names,
        mean=table.channels[rows].mean(axis=0),
        rows=int(np.count_nonzero(rows)),
        temperature=temperature,
        gravity=None if gravity is None else gravity.mean(axis=0),
    )


def table_of_run(run: Run, geometry: Geometry) -> LoadTable:
    """A static run (or the samples of a zero record) as a table; its lines are the rows, counted from 1.

    Raises UserError for a run of another kind, whose samples are no points.
    """
    if run.kind not in ("static", "zero"):
        remedy = "Give a static or a zero run; `balance reduce` computes the loads of records"
        raise UserError(f"is a {run.kind} run, whose samples are no points", run.file, "attribute `kind`", remedy)
    block = run.read()
    names = tuple(name for name in geometry.channel_names if name in run.channel_names)
    return LoadTable(
        path=run.path or Path(run.name),
        lines=tuple(range(1, run.samples + 1)),
        channel_names=names,
        channels=pick_channels(block.channels, run.channel_names, names),
        hub_loads=block.loads,
        labels=_run_labels(run),
        load_units={},
        unused=(),
        digest=run.digest,
        temperature=run_temperature(run),
        attitude=run.attitude,
    )


def _run_labels(run: Run) -> dict[str, tuple[str, ...]]:
    """The labels of the rows of a run, as those of a table."""
    labels = {"run": (run.name,) * run.samples, "series": run.series_labels, "point": run.point_kinds}
    return {key: texts for key, texts in labels.items() if texts is not None}
