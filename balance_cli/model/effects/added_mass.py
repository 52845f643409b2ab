"""`added-mass`: a point mass on the moving part that the geometry does not know.

With N = [I, R(p - g)] the motion of its point p per unit q,

    M -> M + m N' N

The damping matrix stays as it was.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter, Where, position_bound, whole_rig
from balance_cli.model.mechanics.dual_numbers import Dual, stack
from balance_cli.model.mechanics.equations import Equations


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    total = sum(body.mass for body in geometry.bodies)
    start = 0.01 * total
    mass = EffectParameter("mass", "kg", 0.0, start, "The mass; negative where less is there.", start=start)
    far = position_bound(geometry)
    position = (
        EffectParameter(
            axis, "m", 0.0, 0.1, f"Its position along {axis}, rig axes.", -far, far, start=0.5 * at, nuisance=True
        )
        for axis, at in zip("xyz", geometry.hub, strict=True)
    )
    return (mass, *position)


def _starts(geometry: Geometry, where: Where) -> tuple[Mapping[str, float], ...]:
    """Between hub and origin, at the hub, or at one of the cells: what it does depends on where it is."""
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
    summary="A point mass on the moving part that is not in the declared bodies.",
    validity="A compact mass, rigidly fixed.",
    reference="Goldstein, Classical Mechanics, 2nd ed., 1980, chapter 5 (inertia tensor).",
    signature="Eigenfrequencies off, static calibration as declared. Mass, centre of gravity and inertia of "
    "the moving part say the same: with tolerances on these the data alone cannot tell, and the estimate rests on "
    "them.",
    separated_by="Weighing the moving part.",
    place="none",
    places=whole_rig,
    parameters=_parameters,
    apply=_apply,
    starts=_starts,
)
