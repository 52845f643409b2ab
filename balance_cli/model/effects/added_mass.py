"""`added-mass`: a point mass on the metric side that the geometry does not declare.

With N = [I, R(p - g)] the motion of its position p per unit q,

    M -> M + m N' N,        D -> D + c (D(M + m N' N) - D(M))

with D(M) the damping that the damping ratios of the plate give for a mass matrix. For c = 0 the damping stays, as with
a mass that is put on the plate; for c = 1 the ratios stay, as if the mass were a part of the declared ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.geometry_scales import position_bound, rig_length
from balance_cli.model.effects.places import Where, whole_rig
from balance_cli.model.effects.search_hints import PointMassParameters, SearchHints
from balance_cli.model.mechanics.dual_numbers import Dual, block_diagonal, constant, stack
from balance_cli.model.mechanics.equations import Equations

SMALL_ARM = 0.13
"""A change of place that matters, relative to the size of the rig."""
RESTART_MASS = 0.03
"""Mass, relative to that of the metric side, with which a fit in a wrong minimum begins again: larger than most."""


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    total = sum(body.mass for body in geometry.bodies)
    start = 0.01 * total
    mass = EffectParameter("mass", "kg", 0.0, start, "The mass; negative where mass is missing.", start=start)
    far, arm = position_bound(geometry), SMALL_ARM * rig_length(geometry)
    position = (
        EffectParameter(
            axis, "m", 0.0, arm, f"Its position along {axis}, rig axes.", -far, far, start=0.5 * at, nuisance=True
        )
        for axis, at in zip("xyz", geometry.hub, strict=True)
    )
    damping = EffectParameter(
        name="damping_share",
        unit="1",
        null=0.0,
        scale=1.0,
        description="How far the plate's damping follows the mass; at 1 its ratios stay.",
        nuisance=True,
        held=True,
    )
    return (mass, *position, damping)


def _starts(geometry: Geometry, where: Where) -> tuple[Mapping[str, float], ...]:
    """Between hub and origin, at the hub, or at one of the cells."""
    points = [
        0.5 * np.array(geometry.hub),
        np.array(geometry.hub),
        *(np.array(cell.position) for cell in geometry.cells),
    ]
    return tuple(dict(zip("xyz", map(float, point), strict=True)) for point in points)


def _restarts(geometry: Geometry, where: Where) -> tuple[Mapping[str, float], ...]:
    """A fair mass between hub and origin, or at the hub: a small one far away is the wrong end of the valley."""
    mass = RESTART_MASS * sum(body.mass for body in geometry.bodies)
    return tuple({"mass": mass, **start} for start in _starts(geometry, where)[:2])


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    motion = equations.motion(stack([values[axis] for axis in "xyz"]))
    return add_mass(equations, values["mass"] * (motion.T @ motion), values["damping_share"])


def add_mass(equations: Equations, mass: Dual, damping_share: Dual | float) -> Equations:
    """The equations with a further mass matrix (n, n) of the plate, whose damping follows it by a share."""
    wide = replace(equations, mass=equations.mass + mass)
    if equations.plate_damping is None:
        return wide
    n = len(equations.freedom)
    change = equations.plate_damping(wide.mass[:n, :n]) - equations.plate_damping(equations.mass[:n, :n])
    others = len(equations.coordinates) - n
    padding = constant(np.zeros((others, others)), equations.parameters)
    return replace(wide, damping=equations.damping + block_diagonal(damping_share * change, padding))


EFFECT = Effect(
    name="added-mass",
    summary="An undeclared point mass on the metric side.",
    validity="A compact mass that is rigidly attached.",
    reference="Goldstein, Classical Mechanics, 2nd ed., 1980, chapter 5 (inertia tensor).",
    signature="Eigenfrequencies differ from the computed ones while the static calibration agrees. Errors of the "
    "declared mass, center of gravity and inertia of the metric side look the same: with tolerances on these, the "
    "data alone cannot distinguish them, and the estimate depends on the tolerances.",
    separated_by="Weigh the metric side.",
    place="none",
    places=whole_rig,
    parameters=_parameters,
    apply=_apply,
    search=SearchHints(
        starts=_starts,
        restarts=_restarts,
        point_mass=PointMassParameters("mass", ("x", "y", "z"), "damping_share"),
    ),
)
