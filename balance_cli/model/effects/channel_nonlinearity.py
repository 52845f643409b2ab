"""`channel-nonlinearity`: the sensitivity of a channel changes with its reading.

The channel reads v where a linear one would read u:

    v = u + a u^2,        v - u = a u^2,        u = 2 v / (1 + s),        s = sqrt(1 + 4 a v)

Since v is recorded, v - u is known at every instant. Each channel of a group has a coefficient a of its own.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.channel_groups import ALL
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.geometry_scales import channel_range
from balance_cli.model.effects.places import Where, channels_at, each_channel_or_group
from balance_cli.model.effects.search_hints import SearchHints
from balance_cli.model.mechanics.dual_numbers import Dual, stack
from balance_cli.model.mechanics.equations import ChannelDistortion, Equations

Array = NDArray[np.float64]

SMALL = 0.001
"""Nonlinearity that matters, relative to the reading at full range: data sheets of load cells state less."""


def _search_places(geometry: Geometry) -> tuple[Where, ...]:
    """Channels, and groups of one kind: bridges curve all of them, but not together with charge amplifiers."""
    return tuple(where for where in each_channel_or_group(geometry) if where != (ALL,))


def _parameter_name(channel: str, where: Where) -> str:
    return "quadratic" if where == (channel,) else f"quadratic_{channel}"


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    description = "Volts beyond a linear channel per squared volt of that one."
    return tuple(
        EffectParameter(
            _parameter_name(channel, where), "1/V", 0.0, SMALL / channel_range(geometry, channel), description
        )
        for channel in channels_at(geometry, where)
    )


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    for channel in channels_at(geometry, where):
        a = values[_parameter_name(channel, where)]
        index = geometry.channel_names.index(channel)
        equations = equations.with_distortion(ChannelDistortion(index, stack([a]), _squared_linear_reading))
    return equations


def _squared_linear_reading(v: Array, values: Dual) -> Dual:
    """u^2 (n,). Raises LinAlgError where no linear reading makes the channel read v."""
    a = values.value[0]
    square_of_s = 1.0 + 4.0 * a * v
    if not np.all(square_of_s > 0.0):
        raise np.linalg.LinAlgError("a channel reads what its nonlinearity does not let it read")
    s = np.sqrt(square_of_s)
    u = 2.0 * v / (1.0 + s)
    return Dual(u * u, -(2.0 * u * u * u / s) * values.derivative[:, :1])


EFFECT = Effect(
    name="channel-nonlinearity",
    summary="The sensitivity of a channel changes with its reading, as that of a strain gauge bridge does.",
    validity="A nonlinearity of second order without memory, small beside the sensitivity itself; readings count from "
    "the unloaded rig.",
    reference="AIAA R-091A-2020, Calibration and Use of Internal Strain-Gage Balances (terms of second "
    "degree in the math model of a bridge).",
    signature="One channel has lines at sums and differences of the frequencies of its reading, twice each frequency "
    "among them, and another gain at another mean load.",
    separated_by="A static calibration in both directions: the same curvature beside a straight second channel of the "
    "cell. A cell that is nonlinear shows in all of its channels.",
    place="a channel, or a group of channels, each with a coefficient of its own",
    places=each_channel_or_group,
    parameters=_parameters,
    apply=_apply,
    needs_mean=True,
    search=SearchHints(places=_search_places),
)
