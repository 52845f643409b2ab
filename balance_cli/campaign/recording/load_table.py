"""Point tables (CSV) of a static calibration or of loads to be computed, as static runs.

Columns are found by their names: components of the geometry (or hub loads), its load points and channels, and
optionally `series`, `point` (kind of point), `run`, `trim`, `excitation`, `temperature`, `pitch` and `roll`. Units
stand in the head (`Fx [N]`, `Fx (lbf)`, `Fx / N`) or in a row below it.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.load_table_columns import (
    POINT_WORDS,
    Column,
    by_name,
    identify_loads_and_readings,
    plain_name,
    unit_of_column,
    unused_columns,
)
from balance_cli.campaign.recording.load_table_conditions import attitude_notes, attitude_of_rows, temperature_of_rows
from balance_cli.campaign.recording.load_table_points import add_forces_at_points, load_points_of_tables
from balance_cli.campaign.recording.point_labels import POINT_KINDS
from balance_cli.campaign.recording.run import MemorySource, Run, run_digest
from balance_cli.campaign.recording.temperature import temperature_addition
from balance_cli.campaign.rig.components import COMPONENTS, UNIT_OF
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.load_components import load_components, moment_transfer
from balance_cli.io.column_heads import split_unit
from balance_cli.io.errors import UserError
from balance_cli.io.table_text import TextTable, read_table
from balance_cli.io.text_numbers import LOAD_FILLER_RATIO
from balance_cli.io.units import NUMBER, RATIO, VOLTAGE, Unit

Array = NDArray[np.float64]

MOST_ROWS_LISTED, MOST_QUOTED = 5, 30
"""Lines that a message quotes, and letters of each."""
TABLE_TRIM = "table"
"""Label of the trim of a table that names none."""


@dataclass(frozen=True)
class TableReading:
    """How a table is read beside its head: `units` of columns without one, and the point of its moments.

    `moment_center` [m] in rig axes: the point about which the hub loads of the table act; None is the hub. With
    `allow_missing` loads and readings that were not read (`NA`, -9999, a reading that is empty) are NaN.
    """

    units: tuple[Unit, ...] = ()
    moment_center: tuple[float, float, float] | None = None
    allow_missing: bool = False


@dataclass(frozen=True)
class LoadTable:
    """A point table in SI units: `channels` (n, c), `hub_loads` (n, 6) or None, and the labels (n,) of its rows.

    `lines` (n,): line of each row in the file; `load_units`: unit in which the table has each component;
    `unused`: columns that are nothing known; `other_rows`: lines that are no load points, in words, empty for none.
    `temperature` (n,) [degC], `attitude` (n, 2): pitch and roll [deg]; None without columns of them. `notes`: what was
    assumed, in words.
    """

    path: Path
    lines: tuple[int, ...]
    channel_names: tuple[str, ...]
    channels: Array
    hub_loads: Array | None
    labels: Mapping[str, tuple[str, ...]]
    load_units: Mapping[str, Unit]
    unused: tuple[str, ...]
    digest: str
    temperature: Array | None = None
    other_rows: str = ""
    attitude: Array | None = None
    notes: tuple[str, ...] = ()


def read_load_table(path: Path, geometry: Geometry, reading: TableReading | None = None) -> LoadTable:
    """Read a point table of a rig.

    Raises UserError, with file, line and column, where a cell or unit is wrong, a component has no column although
    others have, or no channel has one.
    """
    return _TableReader(read_table(Path(path)), geometry, reading or TableReading()).read()


def is_point_table(path: Path) -> bool:
    """Whether a file is to be read as a table: not HDF5, and not YAML by its name."""
    from balance_cli.io.sniff import is_hdf5

    return path.is_file() and not is_hdf5(path) and path.suffix.lower() not in (".yaml", ".yml", ".h5", ".hdf5")


def runs_of_table(table: LoadTable, geometry: Geometry) -> tuple[Run, ...]:
    """The static runs of a table, one for each label of the columns `run` and `trim`, in the order of their rows."""
    n = len(table.lines)
    run_labels = table.labels.get("run", (table.path.stem,) * n)
    trim_labels = table.labels.get("trim", (TABLE_TRIM,) * n)
    keys = list(zip(run_labels, trim_labels, strict=True))
    several = len({trim for _, trim in keys}) > 1
    runs = []
    for run, trim in dict.fromkeys(keys):
        rows = np.array([key == (run, trim) for key in keys])
        name = f"{run}-{trim}" if several and len({t for r, t in keys if r == run}) > 1 else run
        runs.append(_run_of_rows(table, geometry, name, trim, rows))
    return tuple(runs)


def _run_of_rows(table: LoadTable, geometry: Geometry, name: str, trim: str, rows: NDArray[np.bool_]) -> Run:
    loads = None if table.hub_loads is None else table.hub_loads[rows]
    labels = {key: tuple(np.array(texts)[rows].tolist()) for key, texts in table.labels.items()}
    run = Run(
        name=name,
        rig=geometry.rig,
        kind="static",
        channel_names=table.channel_names,
        samples=int(np.count_nonzero(rows)),
        source=MemorySource(table.channels[rows], loads),
        has_loads=loads is not None,
        trim=trim,
        path=table.path,
        attitude=None if table.attitude is None else table.attitude[rows],
        series_labels=labels.get("series"),
        point_kinds=labels.get("point"),
        additions=None if table.temperature is None else temperature_addition(table.temperature[rows]),
        reading_units=geometry.reading_units(table.channel_names),
    )
    return replace(run, digest=run_digest(run))


def _describe_rows(rows: Sequence[tuple[int, tuple[str, ...]]]) -> str:
    """Lines that are no load points, with the beginning of the first ones; empty for none."""
    texts = [f"{line} (`{', '.join(filter(None, cells))[:MOST_QUOTED]}`)" for line, cells in rows[:MOST_ROWS_LISTED]]
    more = f" and {len(rows) - MOST_ROWS_LISTED} more" if len(rows) > MOST_ROWS_LISTED else ""
    return f"{'line' if len(rows) == 1 else 'lines'} {', '.join(texts)}{more}" if rows else ""


class _TableReader:
    """Assignment of the columns of one table to components, channels and labels, and their conversion."""

    def __init__(self, table: TextTable, geometry: Geometry, reading: TableReading) -> None:
        self.table, self.geometry, self.reading = table, geometry, reading
        self.components = load_components(geometry)
        loads = (*self.components.names, *COMPONENTS, *load_points_of_tables(geometry))
        columns = identify_loads_and_readings(table, loads, geometry.channel_names)
        self.columns = by_name(table, (column for column in columns if column and not column.is_reading))
        self.readings = by_name(table, (column for column in columns if column and column.is_reading))
        self.unused = unused_columns(table, columns)

    def read(self) -> LoadTable:
        """The whole table."""
        names = tuple(name for name in self.geometry.channel_names if name in self.readings)
        if not names:
            heads = ", ".join(self.table.header[:20])
            fault = f"has no column of a channel: its columns are {heads}"
            remedy = f"The channels are {', '.join(self.geometry.channel_names)}"
            raise UserError(fault, str(self.table.path), "head", remedy)
        load_units = dict(self._load_units())
        return LoadTable(
            path=self.table.path,
            lines=tuple(line for line, _ in self.table.rows),
            channel_names=names,
            channels=np.column_stack([self._channel(name) for name in names]),
            hub_loads=self._all_loads(load_units),
            labels=dict(self._labels()),
            load_units=load_units,
            unused=self.unused,
            digest=self.table.digest,
            temperature=temperature_of_rows(self.table, self.columns, self._unit),
            attitude=attitude_of_rows(self.table, self.columns, self._unit),
            notes=tuple(attitude_notes(self.table, self.columns)),
            other_rows=_describe_rows(self.table.other_rows),
        )

    # ---- loads ---------------------------------------------------------------------------------------------------

    def _load_units(self) -> Iterator[tuple[str, Unit]]:
        """Each component of the table with its unit; raises UserError where a component has no column."""
        own = [name for name in self.components.names if name in self.columns]
        hub = [name for name in COMPONENTS if name in self.columns]
        present = hub if len(hub) > len(own) else own
        expected = self.components.names if present == own else COMPONENTS
        missing = [name for name in self.components.names if present == own and name not in self.columns]
        if not present:
            return
        if missing:
            heads = {split_unit(head)[0]: head for head in self.unused}
            near = difflib.get_close_matches(missing[0], heads, n=1, cutoff=0.5)
            remedy = (
                f"Is it `{heads[near[0]]}`? Rename it" if near else "Add it, with zeros where there is no such load"
            )
            remedy += f", or declare the `components` of the balance (now {', '.join(self.components.names)})"
            raise UserError(f"has no column of `{missing[0]}`", str(self.table.path), "head", remedy)
        units = {**UNIT_OF, **dict(zip(self.components.names, self.components.units, strict=True))}
        for name in expected:
            if name in self.columns:
                yield name, self._unit(self.columns[name], units[name])

    def _all_loads(self, load_units: Mapping[str, Unit]) -> Array | None:
        loads, allow = self._hub_loads(load_units) if load_units else None, self.reading.allow_missing
        return add_forces_at_points(loads, self.table, self.columns, self._unit, self.geometry, allow)

    def _hub_loads(self, load_units: Mapping[str, Unit]) -> Array:
        allow = self.reading.allow_missing
        values = {
            name: unit.to_base(self.table.numbers(self.columns[name].index, allow, ratio=LOAD_FILLER_RATIO))
            for name, unit in load_units.items()
        }
        if set(values) <= set(COMPONENTS):
            zero = np.zeros(len(self.table.rows))
            return self._about_hub(np.column_stack([values.get(name, zero) for name in COMPONENTS]))
        if self.reading.moment_center is not None:
            fault = "a moment center is given, but the components have their own lines of action"
            raise UserError(fault, "--moment-center", remedy="Leave it out")
        return np.asarray(np.column_stack([values[name] for name in self.components.names]) @ self.components.to_hub)

    def _about_hub(self, loads: Array) -> Array:
        """Loads (n, 6) about the hub, from loads about the moment center of the table."""
        if self.reading.moment_center is None:
            return loads
        return np.asarray(loads @ moment_transfer(self.reading.moment_center, self.geometry.hub).T)

    # ---- channels and labels -------------------------------------------------------------------------------------

    def _channel(self, name: str) -> Array:
        """Readings (n,) of a channel, in the base unit that the geometry declares."""
        column = self.readings[name]
        expected = next(channel.reading_unit for channel in self.geometry.channels if channel.name == name)
        unit = self._unit(column, *sorted((VOLTAGE, RATIO, NUMBER), key=lambda dimension: dimension != expected))
        allow = self.reading.allow_missing
        values = unit.to_base(self.table.numbers(column.index, allow, allow))
        if unit.dimension == expected:
            return values
        if unit.dimension == VOLTAGE and expected == RATIO and "excitation" in self.columns:
            return np.asarray(values / self._excitation())
        head = self.table.header[column.index]
        remedy = f"Declare `unit: {unit.symbol}` for the channel in the geometry, or convert the column"
        fault = f"is in {unit.symbol}, but the geometry declares channel `{name}` in {expected}"
        raise self.table.error(0, head, fault, remedy)

    def _excitation(self) -> Array:
        column = self.columns["excitation"]
        volts = self._unit(column, VOLTAGE).to_base(self.table.numbers(column.index))
        for (line, _), value in zip(self.table.rows, volts, strict=True):
            if value <= 0:
                fault = f"an excitation of {value:g} V"
                raise self.table.error(line, self.table.header[column.index], fault, "It must be positive")
        return volts

    def _labels(self) -> Iterator[tuple[str, tuple[str, ...]]]:
        for name in ("series", "run", "trim"):
            if name in self.columns:
                yield name, self._filled(self.columns[name])
        if "point" in self.columns:
            kinds = self._point_kinds(self.columns["point"])
            if kinds is not None:
                yield "point", kinds

    def _filled(self, column: Column) -> tuple[str, ...]:
        texts = self.table.texts(column.index)
        for (line, _), text in zip(self.table.rows, texts, strict=True):
            if not text:
                raise self.table.error(line, self.table.header[column.index], "the label is empty", "Write one")
        return texts

    def _point_kinds(self, column: Column) -> tuple[str, ...] | None:
        """Kinds of the points; None for a column of numbers, which counts the points."""
        texts = self._filled(column)
        if all(text.isdigit() for text in texts):
            return None
        kinds = []
        for (line, _), text in zip(self.table.rows, texts, strict=True):
            word = plain_name(text)
            kind = POINT_WORDS.get(word, word)
            if kind not in POINT_KINDS:
                remedy = f"It should be one of {', '.join(POINT_KINDS)}, or a number"
                raise self.table.error(line, self.table.header[column.index], f"`{text[:40]}` is no kind", remedy)
            kinds.append(kind)
        return tuple(kinds)

    def _unit(self, column: Column, *dimensions: str) -> Unit:
        head = self.table.header[column.index]
        try:
            return unit_of_column(column, head, self.reading.units, *dimensions)
        except UserError as error:
            raise self.table.error(0, head, error.fault, error.remedy) from None
