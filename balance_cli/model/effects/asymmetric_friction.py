"""`asymmetric-friction`: a contact beside a cell slips at another force in one direction than in the other.

A contact (`dry-friction`) with the limits F (1 + a) of positive and F (1 - a) of negative forces, d being the cell's
elongation:

    f = kappa (d - w),        -F (1 - a) <= f <= F (1 + a)

Once it has slipped this is a contact with the limit F in both directions and a constant force a F: the same as an
offset of a load along the cell. Only a rig at rest before its first slip shows the difference. The cell's channels do
not read f.
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

RELEVANT_ASYMMETRY = 0.1
"""A difference of the two limits that matters, relative to their sum."""


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    description = "Difference of the two forces over their sum; positive where the cell resists elongation more."
    return (
        contact.force_parameter(
            geometry, where, "force", "Force at which the contact slips, mean of the two directions."
        ),
        EffectParameter("asymmetry", "1", 0.0, RELEVANT_ASYMMETRY, description, -1.0, 1.0, nuisance=True),
        contact.stiffness_parameter(geometry, where),
    )


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    parameters = [values["force"], values["stick_stiffness"], values["asymmetry"]]
    return contact.add_contact(equations, geometry, where, parameters, _friction_shape)


def _friction_shape(motion: CellMotion, values: Dual, least: float) -> Dual:
    return contact.contact_shape(motion, values[0], values[1], least, values[2])


EFFECT = Effect(
    name="asymmetric-friction",
    summary="A contact beside a cell (a seal with a lip, a ratchet, a tilted guide) slips at another force in one "
    "direction than in the other.",
    validity="One contact with the same limits at every speed; the rig was unloaded before each record.",
    reference="Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30 (1994) 1083, section 2.",
    signature="That of dry friction, and a constant force along the cell as soon as it has moved.",
    separated_by="While it slips nothing separates it from dry friction and an offset of a load or of a channel. A rig "
    "at rest that has not moved yet shows the offset alone.",
    place="a cell",
    places=each_measured_cell,
    parameters=_parameters,
    apply=_apply,
    needs_mean=True,
    search=SearchHints(
        extra_starts=contact.slip_starts,
        start_from_score=contact.start_from_score,
        inaccuracy=contact.INACCURACY,
        on_request=True,
    ),
)
