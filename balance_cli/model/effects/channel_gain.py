"""`channel-gain`: a channel reads too much or too little, at every frequency alike."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter, Where, each_channel
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    return (EffectParameter("gain", "1", 1.0, 0.01, "Reading over what the sensitivity promises.", lower=0.0),)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    paths = tuple(
        replace(path, gain=path.gain * values["gain"]) if path.channel == where[0] else path for path in equations.paths
    )
    return replace(equations, paths=paths)


EFFECT = Effect(
    name="channel-gain",
    summary="The channel's sensitivity is not the declared one.",
    validity="Linear channels; one factor for all frequencies and levels.",
    reference="Bendat and Piersol, Random Data, 4th ed., chapter 10 (data acquisition: calibration of the chain).",
    signature="The residual of one channel is a fixed real share of its reading, in every run.",
    separated_by="A calibration of the channel, or the other channel of the same cell.",
    place="a channel",
    places=each_channel,
    parameters=_parameters,
    apply=_apply,
)
