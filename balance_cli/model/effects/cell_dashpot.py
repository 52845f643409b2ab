"""`cell-dashpot`: a viscous force beside a cell, which its channels do not read.

With E_i the elongation of cell i per unit of each coordinate,

    D -> D + d E_i' E_i
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.rig_scales import rig_frequency
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.places import Where, cell_at, each_cell
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations

SMALL = 0.004
"""Dashpot over stiffness of the cell that matters, in periods of the rig's modes: a loss factor of 2.5 % there."""


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    cell = cell_at(geometry, where)
    scale = SMALL / rig_frequency(geometry) * cell.effective_stiffness
    return (EffectParameter("damping", "N s/m", 0.0, scale, "Force per rate of elongation.", lower=0.0),)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    index = geometry.cell_names.index(where[0])
    row = equations.elongation[index : index + 1]
    return replace(equations, damping=equations.damping + values["damping"] * (row.T @ row))


EFFECT = Effect(
    name="cell-dashpot",
    summary="An oil film or a rubber boot beside a cell resists fast motion.",
    validity="Small motions; a force in proportion to speed, the same at every level.",
    reference="Den Hartog, Mechanical Vibrations, 4th ed., 1956, chapter 2 (viscous damping).",
    signature="The modes that stretch this cell are damped more than the others, and its channels lag the load by an "
    "angle that grows with frequency.",
    separated_by="The same sweep with the boot removed. Structural damping of the cell does not grow with frequency.",
    place="a cell",
    places=each_cell,
    parameters=_parameters,
    apply=_apply,
)
