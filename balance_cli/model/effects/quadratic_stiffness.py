"""`quadratic-stiffness`: a cell, or a spring beside it, is stiffer in one direction than in the other.

A force f = k2 d^2 acts along the cell, d being its elongation from the unloaded rig:

    M q'' + D q' + K q = F u - E' f(d),        the cell's channels read k d + f(d) (`inside`) or k d (`beside`)
"""

from __future__ import annotations

from collections.abc import Mapping

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.places import INSIDE, SIDE, Where, cell_at, each_cell_and_side
from balance_cli.model.mechanics.cell_force import CellForce, CellMotion
from balance_cli.model.mechanics.dual_numbers import Dual, stack
from balance_cli.model.mechanics.equations import Equations


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    cell = cell_at(geometry, where)
    k = cell.effective_stiffness
    scale = 0.01 * k * (k / cell.full_range)
    return (EffectParameter("k2", "N/m2", 0.0, scale, "Force over the square of the elongation."),)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    cell, side = where
    spring = equations.springs.index(cell)
    return equations.with_force(CellForce(spring, stack([values["k2"]]), _quadratic_force, side == INSIDE))


def _quadratic_force(motion: CellMotion, values: Dual) -> Dual:
    return motion.elongation * motion.elongation


EFFECT = Effect(
    name="quadratic-stiffness",
    summary="The force along a cell has a part proportional to the square of its elongation.",
    validity="The law holds at every frequency, for elongations within the range of the records.",
    reference="Nayfeh and Mook, Nonlinear Oscillations, 1979, section 2.3 (quadratic and cubic restoring forces).",
    signature="Static curves bend to one side; a vibration shifts the mean reading; the stiffness depends on the mean "
    "load.",
    separated_by="A static run to the rated load in both directions, or sweeps about two mean loads. Only `inside` "
    "leaves the sum of the cells equal to the load.",
    place="a cell, then `inside` or `beside` (default `inside`)",
    places=each_cell_and_side,
    parameters=_parameters,
    apply=_apply,
    choice=SIDE,
    needs_mean=True,
)
