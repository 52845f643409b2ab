"""`channel-gain`: a channel reads too much or too little by the same factor at every frequency."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.places import Where, channels_at, each_channel_or_group
from balance_cli.model.effects.search_hints import ChannelRatio, SearchHints
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations

LEAST_GAIN = 1e-6
"""A channel of less is dead. Of none the relative derivatives would be infinite: fits of a reversed one end at it."""


def _places(geometry: Geometry) -> tuple[Where, ...]:
    """Channels, and groups beside which some cell has another channel.

    A gain of all channels of the cells is one of the declared masses and stiffnesses: only their tolerances tell.
    """
    of_cells = {channel.name for channel in geometry.channels if channel.cell is not None}
    places = each_channel_or_group(geometry)
    return tuple(
        where for where in places if len(of_cells - set(channels_at(geometry, where))) > 0 or len(of_cells) < 2
    )


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    description = "Ratio of the actual to the declared sensitivity."
    return (EffectParameter("gain", "1", 1.0, 0.01, description, lower=LEAST_GAIN),)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    channels = channels_at(geometry, where)
    paths = tuple(
        replace(path, gain=path.gain * values["gain"]) if path.channel in channels else path for path in equations.paths
    )
    return replace(equations, paths=paths)


RATIO = ChannelRatio(
    log_ratio=lambda s, log_gain: np.full_like(s, log_gain),
    derivative=lambda s, log_gain: np.ones_like(s),
    sizes=(1e-5, 1.0),
    start=lambda log_gain: {"gain": float(np.exp(log_gain))},
    finding="{channel} reads {size} times {reference}",
    shown=lambda log_gain, sigma: (np.exp(log_gain), np.exp(log_gain) * sigma),
    sensitivity=True,
)
"""The parameter is the logarithm of the gain."""

EFFECT = Effect(
    name="channel-gain",
    summary="The sensitivity of a channel differs from the declared one.",
    validity="A linear channel; one factor for all frequencies and levels.",
    reference="Bendat and Piersol, Random Data, 4th ed., chapter 10 (data acquisition: calibration of the chain).",
    signature="The residual of one channel is a fixed real fraction of its reading in every run.",
    separated_by="Calibrate the channel, or compare it with the other channel of the same cell.",
    place="a channel, or a group of channels",
    places=_places,
    parameters=_parameters,
    apply=_apply,
    search=SearchHints(channel_ratio=RATIO),
)
