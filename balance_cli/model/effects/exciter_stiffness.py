"""`exciter-stiffness`: an exciter holds the hub while it is attached, by a force that its force cell does not read.

    load of the rig = load of the force cell - stiffness (motion of the hub along the direction)

in sweeps and check runs in which the component is applied: the stinger between exciter and hub resists the motion of
the hub across its axis by its bending stiffness; a guide beyond the force cell resists the motion along it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.rig_scales import stiffness_by_motion
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.exciter_mass import MOTIONS
from balance_cli.model.effects.places import Where, each_component_and_motion, unit_components
from balance_cli.model.effects.search_hints import SearchHints
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations

SMALL = 1e-3
"""A stiffness that matters, relative to that of the cells: it shifts a resonance by 0.05 %."""


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    unit = "N/m" if where[-1].startswith("F") else "N m/rad"
    cells = stiffness_by_motion(geometry)
    scale = SMALL * (cells[MOTIONS[where[-1]]] or max(cells[motion] for motion in "xyz"))
    description = "Stiffness of the exciter against the motion of the hub, along a moment against rotation."
    return (EffectParameter("stiffness", unit, 0.0, scale, description, lower=0.0),)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    at = np.outer(unit_components(where[:1]), unit_components(where[-1:]))
    return replace(equations, exciter_stiffness=equations.exciter_stiffness + values["stiffness"] * at)


EFFECT = Effect(
    name="exciter-stiffness",
    summary="The bending stiffness of a stinger holds the hub across the axis of its exciter while it is attached.",
    validity="A massless linear spring at the hub along one axis, to an exciter that does not move; attached only in "
    "runs in which the exciter works.",
    reference="Ewins, Modal Testing: Theory, Practice and Application, 2nd ed., 2000, chapter 3 (attachment of "
    "exciters).",
    signature="Resonances of the sweeps of one component lie higher than those of the others, most the lowest ones; "
    "static runs, in which no exciter is attached, do not show it.",
    separated_by="A longer or thinner stinger. A stiffness of the rig is there in all runs.",
    place="a load component, or one and the other along which the exciter resists",
    places=each_component_and_motion,
    parameters=_parameters,
    apply=_apply,
    search=SearchHints(on_request=True, in_every_set_up=True),
)
