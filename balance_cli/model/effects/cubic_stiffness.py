"""`cubic-stiffness`: a cell, or a spring beside it, hardens or softens equally in tension and compression.

A force f = k3 d^3 acts along the cell, d being its elongation from the unloaded rig:

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
    scale = 0.01 * k * (k / cell.full_range) ** 2
    return (EffectParameter("k3", "N/m3", 0.0, scale, "Force over the cube of the elongation; positive hardens."),)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    cell, side = where
    spring = equations.springs.index(cell)
    return equations.with_force(CellForce(spring, stack([values["k3"]]), _cubic_force, side == INSIDE))


def _cubic_force(motion: CellMotion, values: Dual) -> Dual:
    d = motion.elongation
    return d * d * d


EFFECT = Effect(
    name="cubic-stiffness",
    summary="The force along a cell has a part proportional to the cube of its elongation.",
    validity="The law holds at every frequency, for elongations within the range of the records.",
    reference="Wigren and Schoukens, Three free data sets for development and benchmarking in nonlinear system "
    "identification, ECC 2013 (the Silverbox); Kerschen et al., Mech. Syst. Signal Process. 20 (2006) 505.",
    signature="Resonances shift with level; static curves bend symmetrically in tension and compression; distortion "
    "appears around the excited spectral lines.",
    separated_by="Sweeps at two levels, or a static run to the rated load. Only `inside` leaves the sum of the cells "
    "equal to the load.",
    place="a cell, then `inside` or `beside` (default `inside`)",
    places=each_cell_and_side,
    parameters=_parameters,
    apply=_apply,
    choice=SIDE,
    needs_mean=True,
)
