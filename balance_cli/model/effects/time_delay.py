"""`time-delay`: a channel is delayed.

g(w) -> g(w) exp(-j w tau)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.rig_scales import rig_frequency
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.places import Where, channels_at, each_channel_or_group
from balance_cli.model.effects.search_hints import ChannelRatio, CommonAlternative, SearchHints
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import ChannelPath, Equations

SMALL = 0.004
"""A delay that matters, in periods of the rig's modes: 1.4 degrees."""
LARGEST = 4.0
"""The largest delay, in such periods: beyond it channel and loads are records of different moments."""


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    description = "Delay of the channel; negative if it is early."
    period = 1.0 / rig_frequency(geometry)
    scale, far = SMALL * period, LARGEST * period
    return (EffectParameter("delay", "s", 0.0, scale, description, lower=-far, upper=far),)


def _add_delay(path: ChannelPath, delay: Dual) -> ChannelPath:
    return replace(path, delay=delay if path.delay is None else path.delay + delay)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    channels = channels_at(geometry, where)
    paths = tuple(_add_delay(path, values["delay"]) if path.channel in channels else path for path in equations.paths)
    return replace(equations, paths=paths)


RATIO = ChannelRatio(
    log_ratio=lambda s, delay: -s * delay,
    derivative=lambda s, delay: -s,
    sizes=(4e-4, 10.0),
    rate_exponent=-1,
    start=lambda delay: {"delay": delay},
    finding="{channel} is late by {size} against {reference}",
    shown=lambda delay, sigma: (1e3 * abs(delay), 1e3 * sigma),
    unit="ms",
    names_positive=True,
)
"""The parameter is the delay [s]."""

LATE_LOADS = CommonAlternative(
    "load-delay@all",
    "Record one signal by the boxes of channels and of loads. Channels that are late or early turn the harmonics of "
    "wind-on loads, exciters' loads that are early or late do not: if it is these, fit `load-delay@all`",
)

EFFECT = Effect(
    name="time-delay",
    summary="A channel is recorded later (or earlier) than the loads.",
    validity="A pure delay, the same at every frequency: scanned multiplexers, digital filters, records combined from "
    "several systems.",
    reference="Bendat and Piersol, Random Data, 4th ed., chapter 2 (linear systems: a delay has linear phase).",
    signature="In one channel the phase falls in proportion to frequency while the amplitude is correct.",
    separated_by="The ratio to the other channel of the same cell, which shows the delay without a model of the plate.",
    place="a channel, or a group of channels",
    places=each_channel_or_group,
    parameters=_parameters,
    apply=_apply,
    search=SearchHints(channel_ratio=RATIO, alike_in_all=LATE_LOADS),
)
