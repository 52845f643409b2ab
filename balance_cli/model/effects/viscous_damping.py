"""`viscous-damping`: a force inside a cell in proportion to the rate of its elongation, which its channels read.

    f = k (d + tau d'),        D -> D + tau k_i E_i' E_i,        g(w) -> g(w) (1 + j w tau)

with E_i the elongation of cell i per unit of each coordinate and g the gain of each of its channels. A dashpot beside
the cell has the first of both only (`cell-dashpot`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from balance_cli.campaign.rig.channel_groups import ALL
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.rig_scales import rig_frequency
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.places import Where, cells_at, each_measured_cell
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations

SMALL_TIME = 0.004
"""A damping time that matters, in periods of the rig's modes: a loss factor of 2.5 % there."""


def _places(geometry: Geometry) -> tuple[Where, ...]:
    """All cells together, then each cell; of no rig with channels that sum cells, which read several forces."""
    measured = each_measured_cell(geometry)
    if any(channel.cells is not None for channel in geometry.channels):
        return ()
    return ((ALL,), *measured) if len(measured) == len(geometry.cells) else measured


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    scale = SMALL_TIME / rig_frequency(geometry)
    description = "Viscous force over elastic force: the loss factor at angular frequency w is w times this value."
    return (EffectParameter("damping_time", "s", 0.0, scale, description, lower=0.0),)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    cells, tau = cells_at(geometry, where), values["damping_time"]
    rows = equations.elongation[cells]
    dashpots = rows.T @ ((tau * equations.stiffness[cells]).insert_axis(-1) * rows)
    paths = tuple(replace(path, lead=(*path.lead, tau)) if path.spring in cells else path for path in equations.paths)
    return replace(equations, damping=equations.damping + dashpots, paths=paths)


EFFECT = Effect(
    name="viscous-damping",
    summary="A cell is damped inside, by oil, rubber or a glued joint: its channels read the viscous force, too.",
    validity="Small motions; a force in proportion to speed, the same at every level.",
    reference="Meirovitch, Fundamentals of Vibrations, 2001, chapter 1 (the Kelvin-Voigt model).",
    signature="The modes that stretch this cell are damped more than the others, and its channels lead those of the "
    "other cells by an angle that grows with frequency.",
    separated_by="A static calibration changes nothing. The load that the cell's channels read in a wind-off sweep far "
    "below its first mode leads the applied one by an angle that grows with frequency.",
    place="a cell, or `all`",
    places=_places,
    parameters=_parameters,
    apply=_apply,
)
