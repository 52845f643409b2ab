"""`extra-mode`: a resonance of free shape that no physical effect explains (empirical).

At a motion (x, y, z) it is a resonator carried by the metric side: a cable, a loose part, a mode of the plate itself.
With an effective mass m, a shape phi over the plate's motions (one in the direction of the place) and e its own motion
relative to the plate

    plate:   (M + (1 - c) m phi phi') q'' + ... + m phi e'' = F u,          e'' + 2 zeta w0 e' + w0^2 e = - phi' q'',

so that it appears in every response, as a mode of a passive structure must, and not at rest. M is the declared mass
matrix, that of a rigid body. For c = 1 the mass m is part of it: a loose part, which swings along phi and is carried
along otherwise. For c = 0 it hangs on beside it and acts along phi only: a cable, whose other motions are elsewhere.

At a load component (Fx .. Mz) it is added to the response of the cells to that load alone. The force of spring i gets

    shape_i R(w) u,        R = (w / w0)^2 / (1 - (w / w0)^2 + 2 j zeta w / w0)

which vanishes at rest, where the springs carry the load in any case. It needs two coordinates: z = u, and

    (e'' + z'') / w0^2 + 2 zeta e' / w0 + e = 0,        so that e = R u
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.campaign.rig.components import COMPONENTS, FREEDOMS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.rig_scales import rig_frequency
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.geometry_scales import rig_length
from balance_cli.model.effects.places import Where
from balance_cli.model.effects.search_hints import SearchHints
from balance_cli.model.mechanics.dual_numbers import Dual, concatenate, constant, stack
from balance_cli.model.mechanics.equations import TORQUE, Equations

AXES = ("x", "y", "z")
SMALL_SHIFT = 0.025
"""A change of frequency that matters, relative to that of the rig's modes: about the width of a mode."""
SMALL_ARM = 0.13
"""A shape that matters in a rotation, relative to the size of the rig."""
SMALL = 0.01
"""An effective mass that matters, as a share of the mass of the metric side, and a fraction of a load."""


def _springs(geometry: Geometry) -> tuple[str, ...]:
    return geometry.cell_names + tuple(meter.label(TORQUE) for meter in geometry.shaft_meters)


def _plate_translations(geometry: Geometry) -> tuple[Where, ...]:
    """One place per translation of the plate."""
    return tuple((axis,) for axis in AXES if axis in geometry.freedom)


def _places(geometry: Geometry) -> tuple[Where, ...]:
    """One place per translation of the plate, then one per load component."""
    return _plate_translations(geometry) + tuple((name,) for name in COMPONENTS)


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    middle = rig_frequency(geometry)
    frequency = EffectParameter(
        name="frequency",
        unit="Hz",
        null=1.5 * middle,
        scale=SMALL_SHIFT * middle,
        description="Eigenfrequency of the mode.",
        lower=SMALL_SHIFT * middle,
        nuisance=True,
    )
    damping = EffectParameter(
        "damping_ratio", "1", 0.0, 0.01, "Its damping ratio.", lower=0.0, upper=1.0, start=0.02, nuisance=True
    )
    shape = _plate_mode_parameters(geometry, where) if where[0] in AXES else _load_mode_parameters(geometry, where)
    return (frequency, damping, *shape)


def _plate_mode_parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    scale = SMALL * sum(body.mass for body in geometry.bodies)
    description = f"Its effective mass along {where[0]}."
    mass = EffectParameter("mass", "kg", 0.0, scale, description, lower=0.0, start=scale)
    shape = (
        EffectParameter(
            f"shape_{name}",
            "1" if name in AXES else "m",
            0.0,
            0.1 if name in AXES else SMALL_ARM * rig_length(geometry),
            f"Its shape in the motion {name} of the center of gravity; one in {where[0]}.",
            nuisance=True,
        )
        for name in geometry.freedom
        if name != where[0]
    )
    described = "Share of its mass that is part of the declared one; the rest acts along its shape only."
    share = EffectParameter("declared_share", "1", 1.0, 0.3, described, nuisance=True)
    return (mass, *shape, share)


def _load_mode_parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    moment = where[0][0] == "M"

    def unit(spring: str) -> str:
        return "1" if moment == (spring not in geometry.cell_names) else "1/m" if moment else "m"

    length = rig_length(geometry)
    size = {"1": 1.0, "m": length, "1/m": 1.0 / length}
    description = "Fraction of the load in {}, times the resonance."
    return tuple(
        EffectParameter(f"shape_{name}", unit(name), 0.0, SMALL * size[unit(name)], description.format(name))
        for name in _springs(geometry)
    )


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    rate = (2 * np.pi * values["frequency"]).reciprocal()
    if where[0] in AXES:
        return _add_plate_mode(equations, where[0], values, rate)
    return _add_load_mode(equations, geometry, where[0], values, rate)


def _add_plate_mode(equations: Equations, axis: str, values: Mapping[str, Dual], rate: Dual) -> Equations:
    p, n = equations.parameters, len(equations.coordinates)
    moving = [FREEDOMS[index] for index in equations.freedom]
    parts = [constant(1.0, p) if name == axis else values[f"shape_{name}"] for name in moving]
    nothing = [constant(0.0, p)] * (n - len(moving))
    wide = equations.with_coordinates(
        names=(f"extra {axis}",),
        mass=rate * rate * np.ones((1, 1)),
        damping=2.0 * values["damping_ratio"] * rate * np.ones((1, 1)),
        inputs=constant(np.zeros((1, 6)), p),
        compliance=constant(np.ones(1), p),
    )
    plate = stack([*parts, *nothing, constant(0.0, p)])
    last = np.eye(n + 1)[:, -1:]
    reaction = values["mass"] * (plate.insert_axis(-1) @ last.T)
    beside = (1.0 - values["declared_share"]) * values["mass"] * (plate.insert_axis(-1) @ plate.insert_axis(0))
    return replace(wide, mass=wide.mass + beside + reaction + rate * rate * (last @ plate.insert_axis(0)))


def _add_load_mode(
    equations: Equations, geometry: Geometry, component: str, values: Mapping[str, Dual], rate: Dual
) -> Equations:
    p, n = equations.parameters, len(equations.coordinates)
    drive = np.zeros((2, 6))
    drive[0, COMPONENTS.index(component)] = 1.0
    wide = equations.with_coordinates(
        names=(f"load {component}", f"extra {component}"),
        mass=rate * rate * np.array([[0.0, 0.0], [1.0, 1.0]]),
        damping=2.0 * values["damping_ratio"] * rate * np.array([[0.0, 0.0], [0.0, 1.0]]),
        inputs=constant(drive, p),
        compliance=constant(np.ones(2), p),
    )
    shape = stack([values[f"shape_{name}"] for name in _springs(geometry)]).insert_axis(-1)
    unread = constant(np.zeros((len(equations.springs) - shape.value.shape[0], 1)), p)
    shape = concatenate([shape, unread])
    nothing = constant(np.zeros((len(equations.springs), n + 1)), p)
    return replace(wide, extra_readings=wide.extra_readings + concatenate([nothing, shape], axis=1))


def _declare_along_largest(where: Where, values: Mapping[str, float]) -> tuple[Where, Mapping[str, float]]:
    """The same resonance declared at its direction of largest motion, where its mass and shape are determined best.

    With s the component of the shape in the new direction, m becomes m s^2 and the shape is divided by s.
    """
    shape = {name: float(value) for name, value in values.items() if name.startswith("shape_")}
    shape[f"shape_{where[0]}"] = 1.0
    largest = max((name for name in shape if name[-2:] in ("_x", "_y", "_z")), key=lambda name: abs(shape[name]))
    part = shape[largest]
    rescaled = {name: value / part for name, value in shape.items() if name != largest}
    others = {name: value for name, value in values.items() if name not in (*shape, "mass")}
    return (largest[-1],), {**others, "mass": float(values["mass"]) * part**2, **rescaled}


EFFECT = Effect(
    name="extra-mode",
    summary="A further resonance of free shape and unknown cause.",
    validity="A description, not an explanation. At a motion it is reciprocal and applies to all loads; at a load "
    "component it applies to that load alone.",
    reference="Ewins, Modal Testing: Theory, Practice and Application, 2nd ed., 2000, chapter 4 (modal constants). "
    "Den Hartog, Mechanical Vibrations, 1956, chapter 3 (a mass on a spring, carried).",
    signature="A peak at one frequency in several channels where the model has none.",
    separated_by="Locate what resonates: a roving accelerometer at the identified frequency.",
    place="the motion x, y or z of the metric side that carries it, or the load component in whose response it appears",
    places=_places,
    parameters=_parameters,
    apply=_apply,
    empirical=True,
    search=SearchHints(
        places=_plate_translations,
        start_at_frequency=lambda frequency: {"frequency": frequency},
        best_place=_declare_along_largest,
    ),
)
