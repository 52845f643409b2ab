"""`quadratic-damping`: a damper beside a cell resists with the square of the speed, as turbulent flow does.

With d' the rate of the cell's elongation,

    f = c2 |d'| d'

The cell's channels do not read f.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.geometry_scales import cell_speed
from balance_cli.model.effects.places import Where, cell_at, each_measured_cell
from balance_cli.model.mechanics.cell_force import CellForce, CellMotion
from balance_cli.model.mechanics.dual_numbers import Dual, stack
from balance_cli.model.mechanics.equations import Equations

RELEVANT_SHARE = 0.01
"""A force that matters where a cell moves through its range at the frequency of the modes, relative to the range."""


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    cell = cell_at(geometry, where)
    scale = RELEVANT_SHARE * cell.full_range / cell_speed(geometry, cell) ** 2
    return (EffectParameter("c2", "N s2/m2", 0.0, scale, "Force over the square of the rate.", lower=0.0),)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    spring = equations.springs.index(where[0])
    return equations.with_force(CellForce(spring, stack([values["c2"]]), _square, read=False, needs_rate=True))


def _square(motion: CellMotion, values: Dual) -> Dual:
    rate = motion.rate
    return rate * rate * np.sign(rate.value)


EFFECT = Effect(
    name="quadratic-damping",
    summary="A damper beside a cell (oil through an orifice, air or water around a part) resists with the square of "
    "its speed.",
    validity="Flow that is turbulent at all speeds; no memory, the same in both directions.",
    reference="Worden and Tomlinson, Nonlinearity in Structural Dynamics, 2001, chapter 2 (quadratic damping).",
    signature="The modes that move this cell are damped the more, the higher the level; their frequencies stay. "
    "Static runs show nothing.",
    separated_by="Sweeps at two levels: linear damping is the same at both, and that by dry friction falls with level.",
    place="a cell",
    places=each_measured_cell,
    parameters=_parameters,
    apply=_apply,
    needs_mean=True,
)
