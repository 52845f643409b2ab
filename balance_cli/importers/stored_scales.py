"""Scales that a file states beside raw integers, in no way that its format defines: they are shown, not applied."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

from balance_cli.importers.base import ChannelGroup

SCALE_WORDS = frozenset(
    (
        *("gain", "scale", "scaling", "scale_factor", "factor", "slope", "multiplier", "resolution", "lsb"),
        *("sensitivity", "offset", "intercept"),
    )
)
"""Names of numbers that convert what a converter gives."""


def stated_scale(numbers: Mapping[str, float]) -> str:
    """Return the numbers that convert integers, such as `gain 0.01, offset 1`; empty where none changes a value."""
    words = {name: value for name, value in numbers.items() if name.lower() in SCALE_WORDS}
    neutral = {"offset": 0.0, "intercept": 0.0}
    if all(value == neutral.get(name.lower(), 1.0) for name, value in words.items()):
        return ""
    return ", ".join(f"{name} {value:g}" for name, value in words.items())


def with_scale_beside(
    groups: Sequence[ChannelGroup], integers: Collection[str], scalars: Mapping[str, float]
) -> list[ChannelGroup]:
    """Return the groups; the channels that hold `integers` with the numbers in the same structure that convert them."""
    return [
        replace(
            group,
            channels=tuple(
                replace(channel, scale=stated_scale(numbers_beside(channel.name, scalars)))
                if channel.name in integers
                else channel
                for channel in group.channels
            ),
        )
        for group in groups
    ]


def numbers_beside(name: str, scalars: Mapping[str, float]) -> dict[str, float]:
    """Return the single numbers in the structure or group that holds a channel, by their own names."""
    cut = max(name.rfind("."), name.rfind("/")) + 1
    return {other[cut:]: value for other, value in scalars.items() if cut and other[:cut] == name[:cut]}
