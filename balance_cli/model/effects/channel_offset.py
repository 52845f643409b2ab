"""`channel-offset`: a constant is added to the reading of a channel.

    y = X g f + offset

Static runs are used about their mean, where the offset cancels except for the apparent elongation of nonlinear cells.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.geometry_scales import channel_range
from balance_cli.model.effects.places import Where, each_channel
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations

SMALL = 2e-4
"""An offset that matters, relative to the reading at the cell's range."""


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    scale = SMALL * channel_range(geometry, where[0])
    return (EffectParameter("offset", "V", 0.0, scale, "Reading of the channel without load."),)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    unit = np.array([float(name == where[0]) for name in equations.channel_names])
    return replace(equations, channel_offset=equations.channel_offset + values["offset"] * unit)


EFFECT = Effect(
    name="channel-offset",
    summary="A channel does not read zero without load.",
    validity="The same offset in all runs; a bridge that drifts between runs has no single offset.",
    reference="Pintelon and Schoukens, System Identification, 2nd ed., 2012, section 2.2 (DC values set apart).",
    signature="A mean in every dynamic record of the channel that does not depend on the load; nothing at any other "
    "frequency.",
    separated_by="A record of the unloaded rig. The offset of a load shifts all strain channels in fixed proportions.",
    place="a channel",
    places=each_channel,
    parameters=_parameters,
    apply=_apply,
    needs_mean=True,
    is_zero_reading=True,
)
