"""Measured supplies of bridges: a channel is its reading over the supply, times the nominal supply."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from balance_cli.campaign.recording.import_map import MappedChannel
from balance_cli.io.errors import UserError
from balance_cli.io.units import VOLTAGE
from balance_cli.steps.import_signals import ChannelFinder, Signal, other_signal


@dataclass(frozen=True)
class Excitations:
    """Signals of the supplies, each once; `of_channels` are channel, supply (their places) and nominal supply [V]."""

    signals: tuple[Signal, ...]
    of_channels: tuple[tuple[int, int, float], ...]
    notes: tuple[str, ...]

    def of_columns(self, first: int) -> tuple[tuple[int, int, float], ...]:
        """The same for a matrix in which the supplies begin at column `first`."""
        return tuple((channel, first + supply, nominal) for channel, supply, nominal in self.of_channels)


def excitation_signals(finder: ChannelFinder, channels: Mapping[str, MappedChannel]) -> Excitations:
    """The supplies that the channels of a map name. Raises UserError where one channel has two units or signs."""
    signals: dict[str, Signal] = {}
    pairs, notes = [], []
    for place, (name, mapped) in enumerate(channels.items()):
        supply = mapped.excitation
        if supply is None:
            continue
        signal = other_signal(finder.find(supply.channel), supply.channel, supply, VOLTAGE, "")
        if signals.setdefault(supply.channel, signal) != signal:
            fault = "is the excitation of several channels, with different units, scales or signs"
            raise UserError(fault, place=f"channel `{supply.channel}`", remedy="State it alike in all of them")
        pairs.append((place, list(signals).index(supply.channel), supply.nominal))
        notes.append(f"{name}: divided by the supply `{supply.channel}`, times {supply.nominal:g} V")
    return Excitations(tuple(signals.values()), tuple(pairs), tuple(notes))
