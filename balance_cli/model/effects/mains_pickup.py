"""`mains-pickup`: a channel picks up the mains.

    y += a cos(2 pi f t + phi),        phi anything in each run

Every phase being as likely as every other, the runs tell a^2: that is what is fitted, and it is regular where it is 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter, Where, each_channel
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations, InterferenceTone


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    return (
        EffectParameter("amplitude", "V", 0.0, 1e-3, "Amplitude before the anti-alias filter.", 0.0, squared=True),
        EffectParameter("frequency", "Hz", 50.0, 0.01, "Frequency of the mains.", 40.0, 70.0, nuisance=True),
    )


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    channel = equations.channel_names.index(where[0])
    pickup = InterferenceTone(channel, values["amplitude^2"], values["frequency"])
    return replace(equations, interference_tones=(*equations.interference_tones, pickup))


EFFECT = Effect(
    name="mains-pickup",
    summary="A channel picks up the mains, at a phase that no two runs share.",
    validity="One frequency and amplitude in all runs; readings at rest are long enough to average it away.",
    reference="Ott, Electromagnetic Compatibility Engineering, 2009, chapter 2; the phase as in Rice, Bell Syst. Tech. "
    "J. 24 (1945) 46.",
    signature="A line at the mains' frequency, and its neighbours where the period is no whole number of "
    "cycles, in one "
    "channel whatever the load.",
    separated_by="A record with the exciter off.",
    place="a channel",
    places=each_channel,
    parameters=_parameters,
    apply=_apply,
    needs_mean=True,
)
