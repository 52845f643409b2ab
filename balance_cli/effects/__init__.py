"""The library of effects, in the order in which they act. A new effect is one file and one line here."""

from balance_cli.effects import channel_gain
from balance_cli.effects.base import Effect, EffectParameter, Where

EFFECTS: tuple[Effect, ...] = (channel_gain.EFFECT,)

__all__ = ["EFFECTS", "Effect", "EffectParameter", "Where"]
