"""`mast-bending`: the hub deflects laterally on a flexible mast.

The hub, a point mass m at h, is part of the declared metric side. Its deflections w relative to the plate are further
coordinates; it moves by N q + w, N the rows of [I, R(h - g)] for the flexible directions:

    kinetic energy    T = 1/2 q' M q + m w' N q + 1/2 m w' w
    hub forces        act on N q + w

with compliance c and damping d = 2 zeta sqrt(m / c). The equation of w is multiplied by c, so that it reads w = 0
where c = 0:

    c (m (N q'' + w'') + d w' - F_hub) + w = 0
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.rig_scales import stiffness_by_motion
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.places import Where, nonempty_subsets
from balance_cli.model.mechanics.dual_numbers import Dual, clip_below, concatenate, constant, stack
from balance_cli.model.mechanics.equations import Equations

AXES = ("x", "y")

SMALL = 1e-1
"""A compliance that matters, and from which a fit may begin, relative to that of all cells together."""
FLOOR = 1e-6
"""Lower bound of mass and compliance in square roots, relative to their scale: zero has no derivative there."""


def _places(geometry: Geometry) -> tuple[Where, ...]:
    """All subsets of the lateral motions of the plate."""
    return nonempty_subsets(tuple(axis for axis in AXES if axis in geometry.freedom))


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    hub = min(geometry.bodies, key=lambda body: float(np.linalg.norm(np.subtract(body.position, geometry.hub))))
    stiffness = stiffness_by_motion(geometry)
    mass = EffectParameter(
        "mass",
        "kg",
        0.0,
        0.1 * hub.mass,
        "Mass that moves with the hub; part of the declared mass of the metric side.",
        lower=0.0,
        start=0.5 * hub.mass,
        nuisance=True,
    )
    compliances = (
        EffectParameter(
            f"compliance_{axis}",
            "m/N",
            0.0,
            SMALL / stiffness[axis],
            f"Deflection of the hub along {axis} relative to the plate, per unit force.",
            lower=0.0,
            start=SMALL / stiffness[axis],
        )
        for axis in where
    )
    damping = EffectParameter(
        "damping_ratio",
        "1",
        0.0,
        0.01,
        "Damping ratio of the hub on the mast, with the plate held.",
        lower=0.0,
        upper=1.0,
        start=0.01,
        nuisance=True,
    )
    return (mass, *compliances, damping)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    p, m, n = equations.parameters, len(where), len(equations.coordinates)
    mass, compliance = values["mass"], stack([values[f"compliance_{axis}"] for axis in where])
    scale = {item.name: FLOOR * item.scale for item in _parameters(geometry, where)}
    floors = np.array([scale[f"compliance_{axis}"] for axis in where])
    ratio = clip_below(mass, scale["mass"]) * clip_below(compliance, floors).reciprocal()
    damping = 2.0 * values["damping_ratio"] * ratio.sqrt()
    moving = equations.motion(np.array(geometry.hub))[["xyz".index(axis) for axis in where]]
    unit = np.eye(6)[[COMPONENTS.index(f"F{axis}") for axis in where]]
    wide = equations.with_coordinates(
        names=tuple(f"hub {axis}" for axis in where),
        mass=mass * np.eye(m),
        damping=damping.insert_axis(-1) * np.eye(m),
        inputs=constant(unit, p),
        compliance=compliance,
    )
    shared = mass * concatenate([moving, constant(np.zeros((m, m)), p)], axis=1)
    lower = concatenate([constant(np.zeros((n, n + m)), p), shared])
    return replace(wide, mass=wide.mass + lower + lower.T)


EFFECT = Effect(
    name="mast-bending",
    summary="The hub, on which the loads act, deflects laterally on a flexible mast.",
    validity="A point mass at the hub and small deflections; the tilt of the hub, and with it the deflection by hub "
    "moments, is neglected.",
    reference="Den Hartog, Mechanical Vibrations, 4th ed., 1956, chapter 3 (a small mass on a large one).",
    signature="Responses to Fx or Fy exceed the rigid ones by an amount that grows with the square of the frequency, "
    "equally in all cells; responses to moments much less so. The static calibration does not change.",
    separated_by="An accelerometer at the hub, or a sweep with a known mass added there.",
    place="x, y or both: the directions in which the mast bends",
    places=_places,
    parameters=_parameters,
    apply=_apply,
)
