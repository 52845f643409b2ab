"""`low-pass`: a channel passes through a further first-order low-pass.

    g(w) -> g(w) / (1 + j w tau),        tau = 1 / (2 pi f_c)

Without the filter f_c is infinite; what is fitted is 1 / f_c, in which the response is regular at zero.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter, Where, each_channel
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    description = "Frequency at which the amplitude is down by half the power."
    return (EffectParameter("cutoff", "Hz", np.inf, 1e-4, description, lower=0.0, reciprocal=True),)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    tau = values["1/cutoff"] * (1.0 / (2 * np.pi))
    paths = tuple(
        replace(path, low_pass=(*path.low_pass, tau)) if path.channel == where[0] else path for path in equations.paths
    )
    return replace(equations, paths=paths)


EFFECT = Effect(
    name="low-pass",
    summary="An amplifier or a long cable rounds off the channel at high frequencies.",
    validity="One first-order low-pass, besides the declared one.",
    reference="Bendat and Piersol, Random Data, 4th ed., chapter 2 (frequency responses of linear systems).",
    signature="Amplitude and phase of one channel fall together towards high frequencies; the reading at rest is "
    "right.",
    separated_by="The other channel of the same cell; a low-pass differs from a delay in that its amplitude falls too.",
    place="a channel",
    places=each_channel,
    parameters=_parameters,
    apply=_apply,
)
