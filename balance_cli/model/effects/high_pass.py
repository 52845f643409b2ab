"""`high-pass`: a channel has a further first-order high-pass.

    g(w) -> g(w) j w / (j w + r),        r = 2 pi f_c

At rest the response is zero.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.rig_scales import rig_frequency
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.places import Where, each_channel
from balance_cli.model.effects.search_hints import ChannelRatio, SearchHints
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations

SMALL = 2.5e-4
"""A cutoff that matters over the frequency of the rig's modes: at a hundredth of that it is 1.4 degrees."""


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    description = "Frequency at which the power is halved."
    return (EffectParameter("cutoff", "Hz", 0.0, SMALL * rig_frequency(geometry), description, lower=0.0),)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    rate = values["cutoff"] * (2 * np.pi)
    paths = tuple(
        replace(path, high_pass=(*path.high_pass, rate)) if path.channel == where[0] else path
        for path in equations.paths
    )
    return replace(equations, paths=paths)


RATIO = ChannelRatio(
    log_ratio=lambda s, rate: -np.log(1 + rate / s),
    derivative=lambda s, rate: -1 / (s + rate),
    sizes=(2e-6, 2.0),
    rate_exponent=1,
    start=lambda rate: {"cutoff": rate / (2 * np.pi)},
    finding="{channel} has a further high-pass, time constant {size}",
    shown=lambda rate, sigma: (1.0 / max(rate, 1e-300), sigma / max(rate, 1e-300) ** 2),
    unit="s",
    one_sided=True,
    at_rest=True,
)
"""The parameter is the rate r [1/s]."""

EFFECT = Effect(
    name="high-pass",
    summary="A channel loses slow changes sooner than declared, as with a leaking charge amplifier.",
    validity="One first-order high-pass in addition to the declared one.",
    reference="Bendat and Piersol, Random Data, 4th ed., chapter 2 (frequency responses of linear systems).",
    signature="One channel leads and reads too little at the lowest frequencies, and reads nothing at rest.",
    separated_by="The other channel of the same cell at low frequency, or a load step.",
    place="a channel",
    places=each_channel,
    parameters=_parameters,
    apply=_apply,
    search=SearchHints(channel_ratio=RATIO),
)
