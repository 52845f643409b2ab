"""`added-mass`: a point mass on the metric side that the geometry does not declare.

With N = [I, R(p - g)] the motion of its position p per unit q,

    M -> M + m N' N

The damping matrix does not change.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.geometry_scales import position_bound
from balance_cli.model.effects.places import Where, whole_rig
from balance_cli.model.effects.search_hints import PointMassParameters, SearchHints
from balance_cli.model.mechanics.dual_numbers import Dual, stack
from balance_cli.model.mechanics.equations import Equations


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    total = sum(body.mass for body in geometry.bodies)
    start = 0.01 * total
    mass = EffectParameter("mass", "kg", 0.0, start, "The mass; negative where mass is missing.", start=start)
    far = position_bound(geometry)
    position = (
        EffectParameter(
            axis, "m", 0.0, 0.1, f"Its position along {axis}, rig axes.", -far, far, start=0.5 * at, nuisance=True
        )
        for axis, at in zip("xyz", geometry.hub, strict=True)
    )
    return (mass, *position)


def _starts(geometry: Geometry, where: Where) -> tuple[Mapping[str, float], ...]:
    """Between hub and origin, at the hub, or at one of the cells."""
    points = [
        0.5 * np.array(geometry.hub),
        np.array(geometry.hub),
        *(np.array(cell.position) for cell in geometry.cells),
    ]
    return tuple(dict(zip("xyz", map(float, point), strict=True)) for point in points)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    motion = equations.motion(stack([values[axis] for axis in "xyz"]))
    return replace(equations, mass=equations.mass + values["mass"] * (motion.T @ motion))


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
    search=SearchHints(starts=_starts, point_mass=PointMassParameters("mass", ("x", "y", "z"))),
)
