"""`low-pass`: a channel has a further first-order low-pass.

    g(w) -> g(w) / (1 + j w tau),        tau = 1 / (2 pi f_c)

Without the filter f_c is infinite; what is fitted is 1 / f_c, in which the response is regular at zero.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.rig_scales import rig_frequency
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.places import Where, channels_at, each_channel_or_group
from balance_cli.model.effects.search_hints import ChannelRatio, CommonAlternative, SearchHints
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations

SMALL = 0.004
"""Frequency of the rig's modes over a cutoff that matters: 0.2 degrees there."""


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    description = "Frequency at which the power is halved."
    scale = SMALL / rig_frequency(geometry)
    return (EffectParameter("cutoff", "Hz", np.inf, scale, description, lower=0.0, reciprocal=True),)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    channels = channels_at(geometry, where)
    tau = values["1/cutoff"] * (1.0 / (2 * np.pi))
    paths = tuple(
        replace(path, low_pass=(*path.low_pass, tau)) if path.channel in channels else path for path in equations.paths
    )
    return replace(equations, paths=paths)


def _cutoff(tau: float, sigma: float) -> tuple[float, float]:
    """Cutoff [Hz] of a time constant tau [s], and its standard deviation."""
    cutoff = 1.0 / (2 * np.pi * tau)
    return cutoff, cutoff * sigma / tau


RATIO = ChannelRatio(
    log_ratio=lambda s, tau: -np.log(1 + s * tau),
    derivative=lambda s, tau: -s / (1 + s * tau),
    sizes=(4e-4, 500.0),
    rate_exponent=-1,
    start=lambda tau: {"1/cutoff": 2 * np.pi * tau},
    finding="{channel} has a further low-pass at {size}",
    shown=lambda tau, sigma: _cutoff(max(tau, 1e-300), sigma),
    unit="Hz",
    one_sided=True,
)
"""The parameter is the time constant tau [s]."""


def _search_places(geometry: Geometry) -> tuple[Where, ...]:
    """Without the group of all channels, whose low-pass the search finds as one of the exciters."""
    every = set(geometry.channel_names)
    return tuple(where for where in each_channel_or_group(geometry) if set(channels_at(geometry, where)) != every)


LAGGING_LOADS = CommonAlternative(
    "exciter-low-pass@all",
    "Record a force cell between exciter and hub. A low-pass of all channels attenuates the harmonics of wind-on "
    "loads, one of the exciters does not: if it is this, fit `exciter-low-pass@all`",
)

EFFECT = Effect(
    name="low-pass",
    summary="An amplifier or a long cable attenuates a channel at high frequencies.",
    validity="One first-order low-pass in addition to the declared one.",
    reference="Bendat and Piersol, Random Data, 4th ed., chapter 2 (frequency responses of linear systems).",
    signature="Amplitude and phase of one channel fall together towards high frequencies; the static reading is "
    "correct.",
    separated_by="The other channel of the same cell. Unlike a delay, a low-pass also reduces the amplitude.",
    place="a channel, or a group of channels",
    places=each_channel_or_group,
    parameters=_parameters,
    apply=_apply,
    search=SearchHints(places=_search_places, channel_ratio=RATIO, alike_in_all=LAGGING_LOADS),
)
