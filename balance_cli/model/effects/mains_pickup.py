"""`mains-pickup`: mains interference in a channel.

    y += a cos(2 pi f t + phi),        phi arbitrary in each run

With all phases equally likely the runs determine a^2, which is what is fitted; the likelihood is regular at a^2 = 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.geometry_scales import channel_range
from balance_cli.model.effects.places import Where, each_channel
from balance_cli.model.effects.search_hints import SearchHints, ToneParameters
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations, InterferenceTone

SMALL = 1e-4
"""An amplitude that matters, relative to the reading at the cell's range."""


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    scale = SMALL * channel_range(geometry, where[0])
    return (
        EffectParameter("amplitude", "V", 0.0, scale, "Amplitude before the anti-alias filter.", 0.0, squared=True),
        EffectParameter("frequency", "Hz", 50.0, 0.01, "Frequency of the mains.", 40.0, 70.0, nuisance=True),
    )


def _starts(geometry: Geometry, where: Where) -> tuple[Mapping[str, float], ...]:
    """The two mains frequencies of the world."""
    return ({"frequency": 50.0}, {"frequency": 60.0})


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    channel = equations.channel_names.index(where[0])
    tone = InterferenceTone(channel, values["amplitude^2"], values["frequency"])
    return replace(equations, interference_tones=(*equations.interference_tones, tone))


EFFECT = Effect(
    name="mains-pickup",
    summary="Mains interference in a channel, with a different phase in each run.",
    validity="One frequency and amplitude in all runs; static readings are long enough to average it out.",
    reference="Ott, Electromagnetic Compatibility Engineering, 2009, chapter 2; the phase as in Rice, Bell Syst. Tech. "
    "J. 24 (1945) 46.",
    signature="A spectral line at the mains frequency in one channel, whatever the load, with leakage into adjacent "
    "lines where the period is not a whole number of cycles.",
    separated_by="A record with the exciter off.",
    place="a channel",
    places=each_channel,
    parameters=_parameters,
    apply=_apply,
    needs_mean=True,
    search=SearchHints(starts=_starts, tone=ToneParameters("amplitude^2", "frequency")),
)
