"""What the head of a point table tells of its balance: loads, channels and the units of their readings.

A calibration needs no more of a geometry than that where the loads are hub loads. The lines of action of other loads
no head can tell.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from balance_cli.campaign.recording.load_table import TableReading
from balance_cli.campaign.recording.load_table_columns import (
    LABELS,
    identify_columns,
    identify_loads_and_readings,
    is_statistic,
    name_and_unit,
)
from balance_cli.campaign.recording.reading_units import channels_of_free_unit, declare_reading_units
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.load_components import load_components
from balance_cli.io.errors import UserError
from balance_cli.io.formats import GEOMETRY_FORMAT
from balance_cli.io.table_text import TextTable, read_table
from balance_cli.io.units import FORCE, MOMENT, NUMBER, RATIO, VOLTAGE, is_unit, parse_unit


@dataclass(frozen=True)
class TableHead:
    """Columns of a point table: hub loads by name, other `loads` by the unit of a force or moment, labels, channels.

    `channels` {name: base unit of the readings}: ratios where the table has V and a column of the bridge excitation.
    """

    hub_loads: tuple[str, ...]
    loads: tuple[str, ...]
    labels: tuple[str, ...]
    channels: dict[str, str]
    rows: int


def read_table_head(path: Path) -> TableHead:
    """Read what the columns of a table are. Raises UserError where the file is no table."""
    table = read_table(path)
    heads = [_name_and_dimension(table, index) for index in range(len(table.header))]
    shared = {name for name, unit in heads if unit in (VOLTAGE, RATIO, NUMBER)}.intersection(COMPONENTS)
    columns = identify_columns(table, (*COMPONENTS, *LABELS), shared)
    known = [None if column is None or column.is_reading else column for column in columns]
    names = [column.name for column in known if column is not None]
    others = [head for head, column in zip(heads, known, strict=True) if column is None]
    readings = {name: unit for name, unit in others if unit in (VOLTAGE, RATIO)}
    if not readings:  # counts only where nothing else can be a reading: rows and points are counted too
        readings = {name: unit for name, unit in others if unit == NUMBER}
    readings = {name: unit for name, unit in readings.items() if not is_statistic(name, readings)}
    if "excitation" in names:
        readings = {name: RATIO if unit == VOLTAGE else unit for name, unit in readings.items()}
    return TableHead(
        hub_loads=tuple(name for name in COMPONENTS if name in names),
        loads=tuple(name for name, unit in others if unit in (FORCE, MOMENT)),
        labels=tuple(name for name in LABELS if name in names),
        channels=readings,
        rows=len(table.rows),
    )


def _name_and_dimension(table: TextTable, index: int) -> tuple[str, str]:
    """Name and base unit of a column; empty where it states no unit, or one with several meanings."""
    name, unit = name_and_unit(table, index)
    if unit is None or not is_unit(unit):
        return name, ""
    for dimensions in ((), (FORCE, MOMENT, VOLTAGE, RATIO, NUMBER)):
        try:
            return name, parse_unit(unit, *dimensions).dimension
        except UserError:
            continue
    return name, ""


def geometry_of_table(path: Path) -> Geometry:
    """The least geometry that a point table needs: its hub loads and its channels, with their units.

    Raises UserError where the head does not tell them.
    """
    head = read_table_head(path)
    remedy = "Give the balance with -g GEOMETRY"
    if head.loads:
        fault = f"the direction of {', '.join(f'`{name}`' for name in head.loads)} is not known: they are no hub loads"
        raise UserError(fault, str(path), "head", f"{remedy}, with these loads as `components`")
    if not head.hub_loads:
        raise UserError("has no column of a hub load, Fx to Mz", str(path), "head", remedy)
    if not head.channels:
        fault = "has no column of readings in V, mV/V or counts"
        raise UserError(fault, str(path), "head", f"Write their units in the head, `B1 [mV/V]`. {remedy}")
    return Geometry.model_validate(
        {
            "format": GEOMETRY_FORMAT,
            "name": path.stem,
            "rig": path.stem,
            "channels": [{"name": name, "unit": unit} for name, unit in head.channels.items()],
            "components": list(head.hub_loads),
        }
    )


def declare_table_units(geometry: Geometry, paths: Sequence[Path], reading: TableReading) -> Geometry:
    """The geometry with the units that tables state for channels whose unit it does not declare.

    Channels of cells and torque meters keep theirs, because their sensitivity is in V.
    """
    return declare_reading_units(geometry, (dict(_stated_units(geometry, path, reading)) for path in paths))


def _stated_units(geometry: Geometry, path: Path, reading: TableReading) -> Iterator[tuple[str, str]]:
    """Channels without a declared unit that a table has in another base unit than V."""
    table = read_table(path)
    free = set(channels_of_free_unit(geometry))
    loads = (*load_components(geometry).names, *COMPONENTS)
    columns = identify_loads_and_readings(table, loads, geometry.channel_names)
    is_supplied = any(column is not None and column.name == "excitation" for column in columns)
    for column in columns:
        if column is None or not column.is_reading or column.name not in free:
            continue
        default = next((unit for unit in reading.units if unit.dimension in (VOLTAGE, RATIO, NUMBER)), None)
        if column.unit is None:
            dimension = VOLTAGE if default is None else default.dimension
        elif is_unit(column.unit):
            dimension = parse_unit(column.unit).dimension
        else:
            continue
        dimension = RATIO if dimension == VOLTAGE and is_supplied else dimension
        if dimension in (RATIO, NUMBER):
            yield column.name, dimension
