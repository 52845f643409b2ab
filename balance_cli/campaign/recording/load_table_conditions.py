"""Conditions of the rows of a point table: temperature of the balance, and attitude of the rig."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.additions_file import WIDE_RANGE
from balance_cli.campaign.recording.load_table_columns import YAW, Column
from balance_cli.campaign.rig.attitude import ANGLES
from balance_cli.io.table_text import TextTable
from balance_cli.io.units import ANGLE, TEMPERATURE, Unit

Array = NDArray[np.float64]
UnitOfColumn = Callable[..., Unit]
"""The unit of a column, among those of some dimensions; raises UserError for another, or none."""

LARGEST_ANGLE = 360.0
"""Attitude [deg] beyond which a number is no angle of a rig, but another unit or another quantity."""


def temperature_of_rows(table: TextTable, columns: Mapping[str, Column], unit_of: UnitOfColumn) -> Array | None:
    """Temperature (n,) [degC]; None without a column of it. Raises UserError for one beyond those of any balance."""
    column = columns.get("temperature")
    if column is None:
        return None
    values = unit_of(column, TEMPERATURE).to_base(table.numbers(column.index))
    for (line, _), value in zip(table.rows, values, strict=True):
        if not WIDE_RANGE[0] <= value <= WIDE_RANGE[1]:
            remedy = "Correct it, or the unit, or remove the column"
            raise table.error(line, table.header[column.index], f"is {value:.4g} degC", remedy)
    return values


def attitude_of_rows(table: TextTable, columns: Mapping[str, Column], unit_of: UnitOfColumn) -> Array | None:
    """Pitch and roll (n, 2) [deg], 0 for the one that has no column; None where neither has.

    Raises UserError for an angle beyond a full turn.
    """
    if not any(name in columns for name in ANGLES):
        return None
    angles = np.zeros((len(table.rows), len(ANGLES)))
    for j, column in enumerate(columns.get(name) for name in ANGLES):
        if column is None:
            continue
        angles[:, j] = np.degrees(unit_of(column, ANGLE).to_base(table.numbers(column.index)))
        for (line, _), value in zip(table.rows, angles[:, j], strict=True):
            if abs(value) > LARGEST_ANGLE:
                remedy = "Correct it, or the unit, or remove the column"
                raise table.error(line, table.header[column.index], f"is {value:.4g} deg", remedy)
    return angles


def attitude_notes(table: TextTable, columns: Mapping[str, Column]) -> Iterator[str]:
    """What is assumed of an attitude of which the table does not have both angles, and of yaw."""
    given = [name for name in ANGLES if name in columns]
    if len(given) == 1:
        other = next(name for name in ANGLES if name not in given)
        yield f"attitude: the table has {given[0]} and no {other}, which is taken as 0"
    if YAW in columns:
        head = table.header[columns[YAW].index]
        yield f"column `{head}` not used: yaw turns the rig about the vertical, which does not change its weight"
