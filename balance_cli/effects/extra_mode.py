"""`extra-mode`: empirical: a resonance that no physical effect explains, added to what the cells feel of one load.

The force of spring i under the load u of the chosen component gets

    shape_i R(w) u,        R = (w / w0)^2 / (1 - (w / w0)^2 + 2 j zeta w / w0)

which vanishes at rest: whatever resonates, there the springs carry the load. Two coordinates carry it: z = u, and

    (e'' + z'') / w0^2 + 2 zeta e' / w0 + e = 0,        so that e = R u
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.components import COMPONENTS
from balance_cli.effects.base import Effect, EffectParameter, Where
from balance_cli.equations import TORQUE, Equations
from balance_cli.geometry import Geometry
from balance_cli.jets import Jet, concatenate, constant, stack


def _springs(geometry: Geometry) -> tuple[str, ...]:
    return geometry.cell_names + ((TORQUE,) if geometry.torque_meter else ())


def _places(geometry: Geometry) -> tuple[Where, ...]:
    """One place a component."""
    return tuple((name,) for name in COMPONENTS)


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    moment = where[0][0] == "M"

    def unit(spring: str) -> str:
        return "1" if moment == (spring == TORQUE) else "1/m" if moment else "m"

    shape = (
        EffectParameter(f"shape_{name}", unit(name), 0.0, 1e-2, f"Share of the load in {name}, times its resonance.")
        for name in _springs(geometry)
    )
    frequency = EffectParameter("frequency", "Hz", 60.0, 1.0, "Eigenfrequency of the mode.", lower=1.0, secondary=True)
    damping = EffectParameter(
        "damping_ratio", "1", 0.0, 0.01, "Its damping ratio.", lower=0.0, upper=1.0, start=0.02, secondary=True
    )
    return (frequency, damping, *shape)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Jet]) -> Equations:
    p, n = equations.parameters, len(equations.coordinates)
    rate = (2 * np.pi * values["frequency"]).reciprocal()
    drive = np.zeros((2, 6))
    drive[0, COMPONENTS.index(where[0])] = 1.0
    wide = equations.with_coordinates(
        names=(f"load {where[0]}", f"extra {where[0]}"),
        mass=rate * rate * np.array([[0.0, 0.0], [1.0, 1.0]]),
        damping=2.0 * values["damping_ratio"] * rate * np.array([[0.0, 0.0], [0.0, 1.0]]),
        inputs=constant(drive, p),
        compliance=constant(np.ones(2), p),
    )
    shape = stack([values[f"shape_{name}"] for name in _springs(geometry)]).expanded(-1)
    nothing = constant(np.zeros((len(equations.springs), n + 1)), p)
    return replace(wide, extra_readings=wide.extra_readings + concatenate([nothing, shape], axis=1))


EFFECT = Effect(
    name="extra-mode",
    summary="One further resonance in the response to one load, of free shape and without a physical cause.",
    validity="A description, not an explanation: it holds for loads of the kind that it was fitted to, and says "
    "nothing of the other components.",
    reference="Ewins, Modal Testing: Theory, Practice and Application, 2nd ed., 2000, chapter 4 (modal constants).",
    trace="A peak at one frequency in several channels, where the model has none.",
    separated_by="Looking for what resonates: a roving accelerometer at the frequency found.",
    place="the load component in whose response it is seen",
    places=_places,
    parameters=_parameters,
    apply=_apply,
    empirical=True,
)
