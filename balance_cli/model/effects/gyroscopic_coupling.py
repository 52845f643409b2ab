"""`gyroscopic-coupling`: parts that spin about z couple pitch and roll of the plate.

The angular momentum H = I Omega e of the spinning parts turns with the plate, whose z axis points to
e = (theta, -phi, 1). Changing H requires the moment H', so that the left-hand sides of the equations of motion gain

    about x (phi):      + I Omega theta'
    about y (theta):    - I Omega phi'

the skew-symmetric matrix Omega G of the equations, Omega = 2 pi times the rotor speed of the run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.rig_scales import inertia_by_motion
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.places import Where
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations


def _places(geometry: Geometry) -> tuple[Where, ...]:
    """The whole rig, if it can tilt about both axes."""
    return ((),) if {"theta", "phi"} <= set(geometry.freedom) else ()


def _about_z(geometry: Geometry) -> float:
    """Declared inertia [kg m2] of the shafts about z; zero without any."""
    return sum(meter.inertia for meter in geometry.shaft_meters if meter.axis == "z")


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    spinning = _about_z(geometry) or 0.1 * inertia_by_motion(geometry)["psi"]
    return (
        EffectParameter(
            "polar_inertia",
            "kg m2",
            0.0,
            0.1 * spinning,
            "Moment of inertia about z of the spinning parts; negative if they turn clockwise seen from above.",
        ),
    )


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    phi, theta = equations.coordinates.index("phi"), equations.coordinates.index("theta")
    G = np.zeros((len(equations.coordinates),) * 2)
    G[phi, theta], G[theta, phi] = 1.0, -1.0
    return replace(equations, gyroscopic=equations.gyroscopic + values["polar_inertia"] * G)


EFFECT = Effect(
    name="gyroscopic-coupling",
    summary="The spinning shaft and hub couple pitch and roll of the plate.",
    validity="Small tilts; an axisymmetric spinning part whose axis stays that of the plate.",
    reference="Den Hartog, Mechanical Vibrations, 4th ed., 1956, chapter 6 (rotating machinery).",
    signature="Nothing at rest. With the rotor turning, the two tilt modes separate into whirl modes, and Mx excites "
    "pitch.",
    separated_by="The same sweep at rest and with the rotor turning.",
    place="none",
    places=_places,
    parameters=_parameters,
    apply=_apply,
    needs_spin=True,
)
