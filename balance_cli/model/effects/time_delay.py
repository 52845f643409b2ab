"""`time-delay`: a channel is late.

g(w) -> g(w) exp(-j w tau)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter, Where, each_channel
from balance_cli.model.mechanics.dual_numbers import Jet
from balance_cli.model.mechanics.equations import ChannelPath, Equations


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    sentence = "How late the channel is, negative where it is early."
    return (EffectParameter("delay", "s", 0.0, 1e-4, sentence, lower=-0.1, upper=0.1),)


def _delayed(path: ChannelPath, delay: Jet) -> ChannelPath:
    return replace(path, delay=delay if path.delay is None else path.delay + delay)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Jet]) -> Equations:
    paths = tuple(_delayed(path, values["delay"]) if path.channel == where[0] else path for path in equations.paths)
    return replace(equations, paths=paths)


EFFECT = Effect(
    name="time-delay",
    summary="A channel is recorded later (or earlier) than the loads.",
    validity="A pure delay, the same at every frequency: scanned multiplexers, digital filters, records put together.",
    reference="Bendat and Piersol, Random Data, 4th ed., chapter 2 (linear systems: a delay has linear phase).",
    trace="A phase that falls in proportion to frequency in one channel, with the amplitude as it should be.",
    separated_by="The other channel of the same cell: their ratio shows the delay without any model of the plate.",
    place="a channel",
    places=each_channel,
    parameters=_parameters,
    apply=_apply,
)
