"""`load-delay`: the signal of an exciter's force cell is recorded late.

    recorded load = exp(-s delay) (load of the exciter)

in sweeps and check runs. A component has a set-up, and often a data-acquisition box, of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.rig_scales import rig_frequency
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.places import Where, all_or_each_component, each_component, unit_components
from balance_cli.model.effects.search_hints import CommonAlternative, SearchHints
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations

SMALL = 0.004
"""A delay that matters, in periods of the rig's modes: 1.4 degrees."""
LARGEST = 4.0
"""The largest delay, in such periods: beyond it channels and loads are records of different moments."""


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    period = 1.0 / rig_frequency(geometry)
    scale, far = SMALL * period, LARGEST * period
    description = "Delay of the load signal; negative if it is early."
    return (EffectParameter("delay", "s", 0.0, scale, description, lower=-far, upper=far),)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    return replace(equations, load_delay=equations.load_delay + values["delay"] * unit_components(where))


EARLY_CHANNELS = CommonAlternative(
    "time-delay@all",
    "Record one signal by the boxes of channels and of loads. Channels that are late or early turn the harmonics of "
    "wind-on loads, exciters' loads that are early or late do not: if it is the former, fit `time-delay@all`",
)

EFFECT = Effect(
    name="load-delay",
    summary="The load of an exciter is recorded later (or earlier) than the channels.",
    validity="A pure delay, the same at every frequency, in all sweeps and check runs of the component.",
    reference="Bendat and Piersol, Random Data, 4th ed., chapter 2 (linear systems: a delay has linear phase).",
    signature="In the sweeps of one component the phase of all channels rises in proportion to frequency.",
    separated_by="Record one signal by both boxes. Loads that are all late cannot be told from "
    "channels that are all early (`time-delay@all`), which would also be so in wind-on runs.",
    place="a load component, or `all`",
    places=all_or_each_component,
    parameters=_parameters,
    apply=_apply,
    search=SearchHints(places=each_component, alike_in_all=EARLY_CHANNELS),
)
