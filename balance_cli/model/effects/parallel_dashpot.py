"""`parallel-dashpot`: a viscous force between plate and ground that bypasses the cells (a damper, an oil film, air).

Three dashpots at one point p of the plate, along the rig's axes; no channel reads them. With N = [I, R(p - g)]

    D -> D + N' diag(d_x, d_y, d_z) N

Their other end is on the ground, not on the non-metric side of the balance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.rig_scales import rig_frequency, stiffness_by_motion
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.geometry_scales import attachment_position, corner_positions
from balance_cli.model.effects.places import Where, whole_rig
from balance_cli.model.effects.search_hints import SearchHints, Start
from balance_cli.model.mechanics.dual_numbers import Dual, stack
from balance_cli.model.mechanics.equations import Equations

SMALL_TIME = 0.0004
"""Dashpot over stiffness of the cells that matters, in periods of the rig's modes: a damping ratio of 0.1 % there."""


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    cells, time = stiffness_by_motion(geometry), SMALL_TIME / rig_frequency(geometry)
    largest = max(cells[axis] for axis in "xyz")
    dashpots = (
        EffectParameter(
            f"damping_{axis}",
            "N s/m",
            0.0,
            time * (cells[axis] or largest),
            f"Force per speed along {axis}.",
            lower=0.0,
            start=time * (cells[axis] or largest),
        )
        for axis in "xyz"
    )
    position = attachment_position(geometry, "Position {axis} of their point of attachment to the plate.")
    return (*position, *dashpots)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    motion = equations.motion(stack([values[axis] for axis in "xyz"]))
    dashpots = stack([values[f"damping_{axis}"] for axis in "xyz"])
    return replace(equations, damping=equations.damping + motion.T @ (dashpots.insert_axis(-1) * motion))


def _extra_starts(geometry: Geometry, where: Where) -> tuple[Start, ...]:
    """Corners of the rig: a score far from the point of attachment is too small; the best one says where to begin."""
    return corner_positions(geometry)


EFFECT = Effect(
    name="parallel-dashpot",
    summary="A damper, an oil film or moving air between plate and ground takes up a force in proportion to speed.",
    validity="Massless linear dashpots at one point, along the rig's axes; the same in every run.",
    reference="Caughey and O'Kelly, Classical normal modes in damped linear dynamic systems, J. Appl. Mech. 32 (1965) "
    "583-588 (damping that couples the modes).",
    signature="Modes that are damped more than the others and coupled by their damping, so that no damping ratios "
    "describe the response; at rest nothing changes.",
    separated_by="The same sweep with the damper removed, or with the air at rest.",
    place="none",
    places=whole_rig,
    parameters=_parameters,
    apply=_apply,
    search=SearchHints(extra_starts=_extra_starts),
)
