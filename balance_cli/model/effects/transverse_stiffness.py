"""`transverse-stiffness`: a cell also restrains the plate transversely, which its channels do not read.

Two springs k perpendicular to the cell's axis, along t1 and t2, act between plate and non-metric side at the cell's
position p:

    K -> K + k N' (t1 t1' + t2 t2') N,        N the motion of the plate at p relative to the non-metric side
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.geometry_scales import transverse_axes
from balance_cli.model.effects.places import Where, cells_at, each_cell_or_all
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    stiffness = [geometry.cells[i].effective_stiffness for i in cells_at(geometry, where)]
    description = "Transverse stiffness, the same in both directions" + (
        ", of each cell." if len(stiffness) > 1 else "."
    )
    return (EffectParameter("stiffness", "N/m", 0.0, 1e-2 * float(np.mean(stiffness)), description, lower=0.0),)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    for index in cells_at(geometry, where):
        cell = geometry.cells[index]
        across = np.array(transverse_axes(cell.direction))
        motion = across @ equations.relative_motion(np.array(cell.position))
        equations = equations.with_springs(motion, values["stiffness"] * np.ones(2))
    return equations


EFFECT = Effect(
    name="transverse-stiffness",
    summary="A cell, with its flexible beam, resists transverse motion and so relieves the other cells of load.",
    validity="Small motions; the same stiffness in both transverse directions, none in rotation.",
    reference="The 1985 paper, section 2, fits flexible beams so that the influence of shear forces is eliminated.",
    signature="At rest the cells carry less than the applied load, most of all where few cells face many; the "
    "eigenfrequencies are higher.",
    separated_by="A shear test of one cell with its beam, or a static calibration with the cell removed.",
    place="a cell, or `all`",
    places=each_cell_or_all,
    parameters=_parameters,
    apply=_apply,
)
