"""Linear calibration matrices as vendors and laboratories write them: plain CSV, and the XML of ATI (`.cal`).

A plain CSV has one line for each component and one column for each channel (loads from readings, T0), or one line for
each channel and one column for each component (readings from loads, C0). Names carry their units: `Fx [N]`,
`B1 [mV/V]`. A column or line `range` states the largest load of each component.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.load_table_columns import plain_name
from balance_cli.campaign.rig.independence import has_independent_columns
from balance_cli.io.column_heads import split_unit
from balance_cli.io.errors import UserError
from balance_cli.io.table_text import TextTable
from balance_cli.io.units import FORCE, MOMENT, NUMBER, RATIO, VOLTAGE, Unit, parse_unit

Array = NDArray[np.float64]

RANGE_WORDS = ("range", "max", "fullscale", "ratedload", "capacity")


@dataclass(frozen=True)
class LinearMatrix:
    """Loads = T0 (readings - zero): T0 (k, c) in SI units per base unit of the readings.

    `channel_names` is None where the file only orders the channels. `reading_units` (c,) are base units; `full_range`
    (k,) [N, N m] is NaN where it is not stated. `name`: serial number or the like.
    """

    components: tuple[str, ...]
    channel_names: tuple[str, ...] | None
    reading_units: tuple[str, ...]
    T0: Array
    full_range: Array
    name: str = ""


def read_linear_csv(table: TextTable, components: Sequence[str], channels: Sequence[str]) -> LinearMatrix:
    """Read a plain matrix with these components and channels; raises UserError with line and column."""
    labels = [(line, cells[0]) for line, cells in table.rows]
    row_names = [_known(split_unit(text)[0], (*components, *channels)) for _, text in labels]
    from_readings = any(name in components for name in row_names)
    row_known, column_known = (components, channels) if from_readings else (channels, components)
    rows = [i for i, name in enumerate(row_names) if name in row_known]
    columns = [
        (j, str(_known(split_unit(head)[0], column_known)))
        for j, head in enumerate(table.header)
        if j and _known(split_unit(head)[0], column_known)
    ]
    if not rows or not columns:
        fault = f"names neither components ({', '.join(components)}) nor channels in its first column and head"
        raise UserError(fault, str(table.path), remedy="Write `Fx [N]` before the lines and `B1 [V]` above the columns")
    values = np.column_stack([table.numbers(j) for j, _ in columns])[rows]
    row_units = [_unit(table, labels[i][0], labels[i][1], "", from_readings) for i in rows]
    heads = [table.header[j] for j, _ in columns]
    below = [table.units[j] if table.units else "" for j, _ in columns]
    column_units = [_unit(table, 0, head, unit, not from_readings) for head, unit in zip(heads, below, strict=True)]
    matrix = values * np.outer([unit.factor for unit in row_units], [1.0 / unit.factor for unit in column_units])
    sides = ([str(row_names[i]) for i in rows], row_units), ([name for _, name in columns], column_units)
    (loads, load_units), (readings, units) = sides if from_readings else reversed(sides)
    _check_complete(table, loads, components)
    order = [loads.index(name) for name in components]
    T0 = (matrix if from_readings else np.linalg.pinv(matrix))[order]
    check_condition(T0, str(table.path))
    ranges = _stated_range(table, rows, [j for j, _ in columns], from_readings)
    in_si = ranges * np.array([unit.factor for unit in load_units])
    return LinearMatrix(tuple(components), tuple(readings), tuple(unit.dimension for unit in units), T0, in_si[order])


def check_condition(T0: Array, file: str) -> None:
    """Raise UserError where a matrix (k, c) does not determine the loads."""
    if not has_independent_columns(T0.T):
        fault = f"does not determine {T0.shape[0]} loads: its lines are combinations of each other"
        raise UserError(fault, file, remedy="Check the matrix, and that it has as many channels as loads")


def _known(name: str, names: Sequence[str]) -> str | None:
    same = [known for known in names if plain_name(known) == plain_name(name)]
    return name if name in names else (same[0] if len(same) == 1 else None)


def _unit(table: TextTable, line: int, head: str, below: str, is_load: bool) -> Unit:
    text = split_unit(head)[1] or below
    dimensions = (FORCE, MOMENT) if is_load else (VOLTAGE, RATIO, NUMBER)
    if not text:
        remedy = f"Write `{head} [{dimensions[0]}]`"
        raise table.error(line, head, "has no unit", remedy)
    try:
        return parse_unit(text, *dimensions)
    except UserError as error:
        raise table.error(line, head, error.fault, error.remedy) from None


def _check_complete(table: TextTable, names: Sequence[str], components: Sequence[str]) -> None:
    for name in components:
        if names.count(name) != 1:
            fault = f"has component `{name}` {names.count(name)} times"
            raise UserError(fault, str(table.path), remedy=f"Give each of {', '.join(components)} once")


def _stated_range(table: TextTable, rows: list[int], columns: list[int], from_readings: bool) -> Array:
    """Largest loads in the units of the loads; NaN where the file does not state them."""
    if from_readings:
        at = next((j for j, head in enumerate(table.header) if plain_name(head) in RANGE_WORDS), None)
        return np.full(len(rows), np.nan) if at is None else table.numbers(at)[rows]
    line = next((i for i, (_, cells) in enumerate(table.rows) if plain_name(cells[0]) in RANGE_WORDS), None)
    if line is None:
        return np.full(len(columns), np.nan)
    return np.array([table.numbers(j)[line] for j in columns])


# ---- writing ---------------------------------------------------------------------------------------------------------


def linear_csv(matrix: LinearMatrix, units: Sequence[str]) -> str:
    """Format a matrix as plain CSV: one line for each component, loads from readings in SI units."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    assert matrix.channel_names is not None
    heads = [f"{name} [{unit}]" for name, unit in zip(matrix.channel_names, matrix.reading_units, strict=True)]
    writer.writerow(["component", *heads, "range"])
    for name, unit, row, size in zip(matrix.components, units, matrix.T0, matrix.full_range, strict=True):
        writer.writerow([f"{name} [{unit}]", *(repr(float(value)) for value in row), repr(float(size))])
    return out.getvalue()


def ati_xml(matrix: LinearMatrix) -> str:
    """Format a matrix of the six hub loads in the XML of ATI: elements UserAxis in N and N m per volt."""
    axes = {"Mx": "Tx", "My": "Ty", "Mz": "Tz"}
    lines = ['<?xml version="1.0" encoding="utf-8"?>']
    count = matrix.T0.shape[1]
    lines.append(f'<FTSensor Serial={quoteattr(matrix.name)} NumGages="{count}" CalFileVersion="1.1">')
    lines.append('\t<Calibration ForceUnits="N" TorqueUnits="N-m" DistUnits="m">')
    for name, row, size in zip(matrix.components, matrix.T0, matrix.full_range, strict=True):
        values = " ".join(f"{value:.10g}" for value in row)
        axis = axes.get(name, name)
        lines.append(f'\t\t<Axis Name="{axis}" values="{values}" max="{size:.6g}" scale="1"/>')
    lines.append('\t\t<BasicTransform Dx="0" Dy="0" Dz="0" Rx="0" Ry="0" Rz="0"/>')
    for name, row, size in zip(matrix.components, matrix.T0, matrix.full_range, strict=True):
        values = " ".join(f"{value:.10g}" for value in row)
        lines.append(f'\t\t<UserAxis Name="{axes.get(name, name)}" values="{values}" max="{size:.6g}"/>')
    return "\n".join([*lines, "\t</Calibration>", "</FTSensor>", ""])
