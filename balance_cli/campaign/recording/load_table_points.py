"""Forces of a point table at the points that the geometry declares: weights on lever arms, ropes over pulleys."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.additions import LoadPoints
from balance_cli.campaign.recording.load_table_columns import LABELS, Column
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.load_components import load_components
from balance_cli.io.table_text import TextTable
from balance_cli.io.text_numbers import LOAD_FILLER_RATIO
from balance_cli.io.units import FORCE, Unit

Array = NDArray[np.float64]


def load_points_of_tables(geometry: Geometry) -> tuple[str, ...]:
    """Names of the declared points that a column can have: with a direction, and of no other meaning."""
    others = {*load_components(geometry).names, *COMPONENTS, *geometry.channel_names, *LABELS}
    points = (geometry.load_points or {}).items()
    return tuple(name for name, point in points if point.direction is not None and name not in others)


def add_forces_at_points(
    loads: Array | None,
    table: TextTable,
    columns: Mapping[str, Column],
    unit_of: Callable[..., Unit],
    geometry: Geometry,
    allow_missing: bool,
) -> Array | None:
    """Hub loads (n, 6) with those of the forces in the columns of points; None where the table has neither."""
    names = tuple(name for name in load_points_of_tables(geometry) if name in columns)
    if not names:
        return loads
    of_names = [columns[name] for name in names]
    cells = [table.numbers(column.index, allow_missing, ratio=LOAD_FILLER_RATIO) for column in of_names]
    force = np.column_stack(
        [unit_of(column, FORCE).to_base(values) for column, values in zip(of_names, cells, strict=True)]
    )
    declared = [(geometry.load_points or {})[name] for name in names]
    position = np.array([point.position for point in declared], float)
    directions = LoadPoints(names, np.array([point.direction for point in declared], float), position).unit_directions
    at_points = force @ np.hstack([directions, np.cross(position - np.array(geometry.hub), directions)])
    return np.asarray(at_points if loads is None else loads + at_points)
