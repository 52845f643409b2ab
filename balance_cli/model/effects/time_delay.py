"""`time-delay`: a channel is late.

g(w) -> g(w) exp(-j w tau)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter, Where, each_channel
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import ChannelPath, Equations


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    description = "How late the channel is, negative where it is early."
    return (EffectParameter("delay", "s", 0.0, 1e-4, description, lower=-0.1, upper=0.1),)


def _add_delay(path: ChannelPath, delay: Dual) -> ChannelPath:
    return replace(path, delay=delay if path.delay is None else path.delay + delay)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    paths = tuple(_add_delay(path, values["delay"]) if path.channel == where[0] else path for path in equations.paths)
    return replace(equations, paths=paths)


EFFECT = Effect(
    name="time-delay",
    summary="A channel is recorded later (or earlier) than the loads.",
    validity="A pure delay, the same at every frequency: scanned multiplexers, digital filters, records put together.",
    reference="Bendat and Piersol, Random Data, 4th ed., chapter 2 (linear systems: a delay has linear phase).",
    signature="A phase that falls in proportion to frequency in one channel, with the amplitude as it should be.",
    separated_by="The other channel of the same cell: their ratio shows the delay without any model of the plate.",
    place="a channel",
    places=each_channel,
    parameters=_parameters,
    apply=_apply,
)
