"""`parallel-stiffness`: a load path from the plate to ground that bypasses the cells (a hose, a cable, a rubbing part).

Three springs at one point p of the plate, along the rig's axes, each with a dashpot in parallel; no channel reads them.
With N = [I, R(p - g)] and one time constant tau for all,

    K -> K + N' diag(k_x, k_y, k_z) N,        D -> D + tau N' diag(k_x, k_y, k_z) N

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

SMALL = 1e-2
"""A stiffness that matters, and from which a fit may begin, relative to that of the cells."""

SMALL_TIME = 0.004
"""A damping time that matters, in periods of the rig's modes: a loss factor of 2.5 % there."""


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    cells = stiffness_by_motion(geometry)
    largest = max(cells[axis] for axis in "xyz")
    springs = (
        EffectParameter(
            f"stiffness_{axis}",
            "N/m",
            0.0,
            SMALL * (cells[axis] or largest),
            f"Stiffness along {axis}.",
            lower=0.0,
            start=SMALL * (cells[axis] or largest),
        )
        for axis in "xyz"
    )
    damping = EffectParameter(
        "damping_time",
        "s",
        0.0,
        SMALL_TIME / rig_frequency(geometry),
        "Dashpot over spring: the loss factor at angular frequency w is w times this value.",
        lower=0.0,
        start=SMALL_TIME / rig_frequency(geometry),
        nuisance=True,
    )
    position = attachment_position(geometry, "Position {axis} of its point of attachment to the plate.")
    return (*position, *springs, damping)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    motion = equations.motion(stack([values[axis] for axis in "xyz"]))
    stiffness = stack([values[f"stiffness_{axis}"] for axis in "xyz"])
    dashpots = motion.T @ ((values["damping_time"] * stiffness).insert_axis(-1) * motion)
    return replace(equations.with_springs(motion, stiffness), damping=equations.damping + dashpots)


def _extra_starts(geometry: Geometry, where: Where) -> tuple[Start, ...]:
    """Corners of the rig: a score far from the point of attachment is too small; the best one says where to begin."""
    return corner_positions(geometry)


def _start_from_score(geometry: Geometry, where: Where, start: Start, estimate: Start) -> Start:
    """The stiffnesses that the score estimates there; one that it finds absent begins small, so that it can grow."""
    small = {item.fitted_name: 0.1 * item.scale for item in _parameters(geometry, where)}
    return {**start, **{name: max(value, small[name]) for name, value in estimate.items()}}


EFFECT = Effect(
    name="parallel-stiffness",
    summary="Part of the load bypasses the cells through a spring between plate and ground.",
    validity="Massless linear springs and dashpots at one point, along the rig's axes.",
    reference="Tropea, Yarin and Foss (eds.), Springer Handbook of Experimental Fluid Mechanics, 2007, chapter 8 "
    "(force and moment measurement).",
    signature="At rest the cells carry a fixed fraction less than the applied load; the eigenfrequencies are higher.",
    separated_by="A static calibration with and without the hose, cable or fouling.",
    place="none",
    places=whole_rig,
    parameters=_parameters,
    apply=_apply,
    search=SearchHints(extra_starts=_extra_starts, start_from_score=_start_from_score),
)
