"""`exciter-mass`: a mass beyond the force cell of an exciter moves with the hub while the exciter is attached.

    load of the rig = load of the force cell - mass (acceleration of the hub along the motion)

in sweeps and check runs in which the component is applied: half a force cell, a stud, a stinger, an adapter. The motion
is that of the component, or another one: the arm on which an exciter of a moment pulls moves with the hub, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.campaign.rig.components import FREEDOMS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.rig_scales import inertia_by_motion
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.places import Where, each_component_and_motion, unit_components
from balance_cli.model.effects.search_hints import SearchHints
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations

SMALL = 1e-3
"""A mass that matters, relative to that of the metric side: it shifts a resonance by 0.05 %."""
MOTIONS = dict(zip(("Fx", "Fy", "Fz", "Mx", "My", "Mz"), ("x", "y", "z", "phi", "theta", "psi"), strict=True))
"""The motion of the plate in which each component works."""


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    assert set(MOTIONS.values()) == set(FREEDOMS)
    unit = "kg" if where[-1].startswith("F") else "kg m2"
    scale = SMALL * inertia_by_motion(geometry)[MOTIONS[where[-1]]]
    description = "Mass, along a moment moment of inertia, beyond the force cell."
    return (EffectParameter("mass", unit, 0.0, scale or SMALL, description, lower=0.0),)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    at = np.outer(unit_components(where[:1]), unit_components(where[-1:]))
    return replace(equations, exciter_mass=equations.exciter_mass + values["mass"] * at)


EFFECT = Effect(
    name="exciter-mass",
    summary="Part of an exciter, beyond its force cell, moves with the hub.",
    validity="A rigid mass that moves along one axis, that of its exciter or another one; attached only in runs in "
    "which the exciter works.",
    reference="Ewins, Modal Testing: Theory, Practice and Application, 2nd ed., 2000, chapter 3 (mass cancellation).",
    signature="Resonances of the sweeps of one component lie lower than those of the others; at low frequency nothing.",
    separated_by="Weigh what is beyond the force cell. A mass of the rig lowers the resonances in all sweeps.",
    place="a load component, or one and the other along which the mass moves",
    places=each_component_and_motion,
    parameters=_parameters,
    apply=_apply,
    search=SearchHints(in_every_set_up=True),
)
