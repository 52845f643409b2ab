"""`cell-misalignment`: the axis of a cell is tilted by two small angles.

With t1, t2 the unit vectors perpendicular to the declared axis a (y and z for a cell along x, and so on cyclically),

    a -> (a + alpha_1 t1 + alpha_2 t2) / sqrt(1 + alpha_1^2 + alpha_2^2)

and the cell's row of E follows: its force acts, and is measured, along the tilted axis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.geometry_scales import transverse_axes
from balance_cli.model.effects.places import Where, cell_at, each_cell
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    axes = transverse_axes(cell_at(geometry, where).direction)
    toward = ("xyz"[int(np.argmax(np.abs(axis)))] for axis in axes)
    return tuple(
        EffectParameter(
            f"angle_{i}", "rad", 0.0, 0.005, f"Tilt of its upper end towards {name}.", lower=-0.5, upper=0.5
        )
        for i, name in enumerate(toward, 1)
    )


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    cell = cell_at(geometry, where)
    first, second = transverse_axes(cell.direction)
    a, b = values["angle_1"], values["angle_2"]
    axis = (cell.direction + a * first + b * second) * (1.0 + a * a + b * b).sqrt().reciprocal()
    motion = equations.relative_motion(np.array(cell.position))
    tilted = np.zeros((len(equations.springs), 1))
    tilted[geometry.cell_names.index(cell.name)] = 1.0
    row = axis.insert_axis(0) @ motion
    return replace(equations, elongation=equations.elongation * (1.0 - tilted) + tilted * row)


EFFECT = Effect(
    name="cell-misalignment",
    summary="A cell is not aligned with its declared axis.",
    validity="Small angles that do not depend on load; the lower end of the cell stays at its declared position.",
    reference="AIAA R-091-2003, Calibration and Use of Internal Strain-Gage Balances (linear interactions).",
    signature="A fixed fraction of a transverse load appears in this cell, in static and dynamic runs, and fractions "
    "of opposite sign in its neighbors, so that the cells still add up to the load.",
    separated_by="A static calibration with the direction of the exciter checked: a misaligned exciter shows in all "
    "cells under one load, a misaligned cell in one cell under all loads.",
    place="a cell",
    places=each_cell,
    parameters=_parameters,
    apply=_apply,
)
