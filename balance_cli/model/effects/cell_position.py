"""`cell-position`: a cell acts on a line beside its declared one.

With a the cell's axis, t1, t2 the unit vectors perpendicular to it, and B(p) the motion of a point p of the plate,

    row of E -> row of E + a (B(p + o1 t1 + o2 t2) - B(p))

A shift along the axis does nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.geometry_scales import position_bound, rig_length, transverse_axes
from balance_cli.model.effects.places import Where, cell_at, each_cell
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations, dual_motion_at

SMALL = 0.003
"""A shift that matters, relative to the size of the rig: 1 mm at 0.3 m."""


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    axes = transverse_axes(cell_at(geometry, where).direction)
    toward = ("xyz"[int(np.argmax(np.abs(axis)))] for axis in axes)
    scale, bound = SMALL * rig_length(geometry), position_bound(geometry)
    return tuple(
        EffectParameter(f"offset_{i}", "m", 0.0, scale, f"Shift of its line of action towards {name}.", -bound, bound)
        for i, name in enumerate(toward, 1)
    )


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    cell = cell_at(geometry, where)
    first, second = transverse_axes(cell.direction)
    declared = np.array(cell.position)
    point = values["offset_1"] * first + values["offset_2"] * second + declared
    moved = equations.motion(point) - dual_motion_at(point) @ equations.non_metric_motion
    change = cell.direction @ (moved - equations.relative_motion(declared))
    at_cell = np.zeros((len(equations.springs), 1))
    at_cell[geometry.cell_names.index(cell.name)] = 1.0
    return replace(equations, elongation=equations.elongation + at_cell * change.insert_axis(0))


EFFECT = Effect(
    name="cell-position",
    summary="A cell acts on a line beside its declared position.",
    validity="A shift that does not depend on load; the direction of the cell is the declared one.",
    reference="AIAA R-091-2003, Calibration and Use of Internal Strain-Gage Balances (linear interactions).",
    signature="The cells still add up to the forces, but not to the moments: one cell's arm is wrong, in static and "
    "dynamic runs.",
    separated_by="Measure the cell's position. A misaligned cell also reads a fraction of the forces across it.",
    place="a cell",
    places=each_cell,
    parameters=_parameters,
    apply=_apply,
)
