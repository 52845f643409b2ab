"""`stribeck-friction`: the friction of a contact beside a cell falls with speed, as a film of oil builds up.

With s the force of a contact over its limit (`dry-friction`; -1 to 1, a spring until it slips) and d' the rate of the
cell's elongation,

    f = (Fc + (Fs - Fc) exp(-(d' / vs)^2)) s,        s = (d - w) kappa / Fs,        |s| <= 1

Both forces are linear in f: Fc (`force`) is that of fast motion, Fs (`static_force`) that of slow motion. The cell's
channels do not read f.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects import contact
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.geometry_scales import cell_speed
from balance_cli.model.effects.places import Where, cell_at, each_measured_cell
from balance_cli.model.effects.search_hints import SearchHints, Start
from balance_cli.model.mechanics.cell_force import CellMotion
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations

Array = NDArray[np.float64]

SPEEDS = (3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1)
"""Speeds at which a search scores a contact, relative to that of a cell which moves through its range at the frequency
of the modes: half decades about the speeds of records."""


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    speed = SPEEDS[3] * cell_speed(geometry, cell_at(geometry, where))
    description = "Speed at which the excess of the static force has fallen to 1/e."
    return (
        contact.force_parameter(geometry, where, "force", "Friction at high speed (Coulomb)."),
        contact.force_parameter(geometry, where, "static_force", "Friction at low speed, at which the contact slips."),
        EffectParameter("speed", "m/s", speed, 0.3 * speed, description, 1e-3 * speed, start=speed, nuisance=True),
        contact.stiffness_parameter(geometry, where),
    )


def _extra_starts(geometry: Geometry, where: Where) -> tuple[Start, ...]:
    fastest = cell_speed(geometry, cell_at(geometry, where))
    return tuple(
        {**start, "speed": share * fastest} for start, share in product(contact.slip_starts(geometry, where), SPEEDS)
    )


def _start_from_score(geometry: Geometry, where: Where, start: Start, estimate: Start) -> Start:
    """The forces that the score estimates, with the stiffness that gives the slip distance of the score."""
    slipping = max(estimate["static_force"], estimate["force"])
    return {**contact.start_from_force(geometry, where, start, slipping), **estimate, "static_force": slipping}


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    shared = [values["static_force"], values["stick_stiffness"], values["speed"]]
    for name, is_slow in (("force", False), ("static_force", True)):
        held = _held_force if is_slow else _held_nothing
        shape = partial(_friction_shape, is_slow=is_slow)
        parameters = [values[name], *shared]
        equations = contact.add_contact(equations, geometry, where, parameters, shape, held, needs_rate=True)
    return equations


def _friction_shape(motion: CellMotion, values: Dual, least: float, is_slow: bool) -> Dual:
    """The contact times the share of its static force at the present speed, or times what that leaves."""
    force = contact.contact_shape(motion, values[1], values[2], least)
    ratio = motion.rate * values[3].reciprocal()
    share = (-(ratio * ratio)).exp()
    return force * (share if is_slow else 1.0 - share)


def _held_force(values: Array, span: float) -> float:
    return contact.held_force(values[1:], span)


def _held_nothing(values: Array, span: float) -> float:
    return 0.0


EFFECT = Effect(
    name="stribeck-friction",
    summary="The friction of a contact beside a cell (a lubricated seal, a guide, a screw) falls with speed.",
    validity="One contact, the same in both directions; friction follows the speed at once; the rig was unloaded "
    "before each record.",
    reference="Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30 (1994) 1083, section 2.",
    signature="That of dry friction, with a force that is larger at low levels and around the turns of the motion.",
    separated_by="Records at low and at high speed. Dry friction with a soft contact looks alike within one level.",
    place="a cell",
    places=each_measured_cell,
    parameters=_parameters,
    apply=_apply,
    needs_mean=True,
    search=SearchHints(
        extra_starts=_extra_starts, start_from_score=_start_from_score, inaccuracy=contact.INACCURACY, on_request=True
    ),
)
