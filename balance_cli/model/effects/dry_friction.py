"""`dry-friction`: a contact beside a cell sticks, and slips once its force exceeds a limit.

A spring kappa in series with a slider that transmits at most F (Jenkins' element), d being the cell's elongation:

    f = kappa (d - w),        w constant until |f| would exceed F, then following d: |d - w| <= F / kappa

The cell's channels do not read f. For F below 1e-5 of the cell's range the slip distance keeps its value at that force,
and f is proportional to F: so f has a derivative at F = 0, where kappa has no effect. There kappa stands only for the
slip distance, and a search scores a contact at several slip distances, from one that always slips to one that mostly
sticks.
"""

from __future__ import annotations

from collections.abc import Mapping

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects import contact
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.places import Where, each_measured_cell
from balance_cli.model.effects.search_hints import SearchHints
from balance_cli.model.mechanics.cell_force import CellMotion
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    force = contact.force_parameter(geometry, where, "force", "Force at which the contact slips.")
    return (force, contact.stiffness_parameter(geometry, where))


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    parameters = [values["force"], values["stick_stiffness"]]
    return contact.add_contact(equations, geometry, where, parameters, _friction_shape)


def _friction_shape(motion: CellMotion, values: Dual, least: float) -> Dual:
    return contact.contact_shape(motion, values[0], values[1], least)


EFFECT = Effect(
    name="dry-friction",
    summary="A contact beside a cell (a seal, a cable, a stop) sticks at small motions and slips at large ones.",
    validity="One contact with the same limit in both directions and at every speed; the rig was unloaded before each "
    "record.",
    reference="Iwan, J. Appl. Mech. 33 (1966) 893; Gaul and Nitsche, Appl. Mech. Rev. 54 (2001) 93.",
    signature="Static curves form loops: loading and unloading differ by twice the force. In sweeps at low level the "
    "stiffness is higher and the damping lower than at high level.",
    separated_by="Sweeps at a very low level, where the contact sticks, or a slow static loop. Structural damping "
    "does not depend on level.",
    place="a cell",
    places=each_measured_cell,
    parameters=_parameters,
    apply=_apply,
    needs_mean=True,
    search=SearchHints(
        extra_starts=contact.slip_starts, start_from_score=contact.start_from_score, inaccuracy=contact.INACCURACY
    ),
)
