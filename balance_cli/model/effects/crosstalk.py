"""`crosstalk`: a fraction of the voltage of one channel is added to another.

    y_to -> y_to + epsilon y_from

where y_from is the voltage without any crosstalk: several crosstalk effects are not applied in series.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.places import Where, ordered_pairs
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Crosstalk, Equations


def _places(geometry: Geometry) -> tuple[Where, ...]:
    return ordered_pairs(geometry.channel_names)


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    description = f"Fraction of {where[1]} that is added to {where[0]}."
    return (EffectParameter("fraction", "1", 0.0, 0.002, description, lower=-1.0, upper=1.0),)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    to, source = (equations.channel_names.index(name) for name in where)
    item = Crosstalk(to, source, values["fraction"])
    return replace(equations, crosstalk=(*equations.crosstalk, item))


EFFECT = Effect(
    name="crosstalk",
    summary="A channel picks up a fraction of the signal of another channel.",
    validity="A fixed real fraction: adjacent leads, a common supply, amplifiers that are not isolated.",
    reference="Ott, Electromagnetic Compatibility Engineering, 2009, chapter 2 (cabling).",
    signature="The residual of one channel is a fixed real fraction of the reading of another channel, whatever the "
    "load.",
    separated_by="Short the input of the channel, or compare it with the other channel of the same cell, which is not "
    "affected.",
    place="two channels: the one affected, then the source",
    places=_places,
    parameters=_parameters,
    apply=_apply,
)
