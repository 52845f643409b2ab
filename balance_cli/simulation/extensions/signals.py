"""Effects in the measuring chain: what becomes of a channel's volts before the anti-alias filter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from balance_cli.simulation import filters
from balance_cli.simulation.extensions.base import Extension, Signals

Array = NDArray[np.float64]


def _map_channels(extension: Extension, signals: Signals, change: Callable[[Array], Array]) -> Array:
    """Volts in which `change` has been applied to each channel (n,) where the extension acts."""
    volts = signals.volts.copy()
    for index in extension.places(signals.names):
        volts[:, index] = change(volts[:, index])
    return volts


@dataclass(frozen=True)
class TimeDelay(Extension):
    """The channel is late by `delay` [s] (early where negative)."""

    name: ClassVar[str] = "time-delay"
    delay: float = 0.0

    def volts(self, signals: Signals) -> Array:
        """Shifted; before the record the rig stood still."""
        step = signals.step
        return _map_channels(self, signals, lambda v: v if step is None else filters.delay_signal(v, self.delay, step))


@dataclass(frozen=True)
class LowPass(Extension):
    """A further first-order low-pass at `cutoff` [Hz]."""

    name: ClassVar[str] = "low-pass"
    cutoff: float = np.inf

    def volts(self, signals: Signals) -> Array:
        """Filtered; a reading at rest passes."""
        step = signals.step
        if step is None or np.isinf(self.cutoff):
            return signals.volts
        return _map_channels(self, signals, lambda v: filters.low_pass(v, self.cutoff, step))


@dataclass(frozen=True)
class HighPass(Extension):
    """A first-order high-pass at `cutoff` [Hz]."""

    name: ClassVar[str] = "high-pass"
    cutoff: float = 0.0

    def volts(self, signals: Signals) -> Array:
        """Filtered; nothing of a reading at rest passes."""
        step = signals.step
        if self.cutoff == 0:
            return signals.volts
        tau = 1 / (2 * np.pi * self.cutoff)
        return _map_channels(
            self, signals, lambda v: np.zeros_like(v) if step is None else filters.high_pass(v, tau, step)
        )


@dataclass(frozen=True)
class ChannelGain(Extension):
    """The channel gives `gain` times its volts."""

    name: ClassVar[str] = "channel-gain"
    gain: float = 1.0

    def volts(self, signals: Signals) -> Array:
        """Scaled."""
        return _map_channels(self, signals, lambda v: self.gain * v)


@dataclass(frozen=True)
class Crosstalk(Extension):
    """The first channel takes up a `fraction` of the volts of the second."""

    name: ClassVar[str] = "crosstalk"
    fraction: float = 0.0

    def volts(self, signals: Signals) -> Array:
        """Mixed."""
        to, source = self.pair(signals.names)
        volts = signals.volts.copy()
        volts[:, to] += self.fraction * volts[:, source]
        return volts


@dataclass(frozen=True)
class ChannelOffset(Extension):
    """The channel reads `offset` [V] too much."""

    name: ClassVar[str] = "channel-offset"
    offset: float = 0.0

    def volts(self, signals: Signals) -> Array:
        """Shifted."""
        return _map_channels(self, signals, lambda v: v + self.offset)


@dataclass(frozen=True)
class MainsPickup(Extension):
    """The channel picks up a sinusoid of `amplitude` [V] and `frequency` [Hz], at a phase that no two runs share."""

    name: ClassVar[str] = "mains-pickup"
    amplitude: float = 0.0
    frequency: float = 50.0

    def volts(self, signals: Signals) -> Array:
        """Added, at the same phase in every channel; readings at rest are long enough to average it away."""
        if signals.step is None:
            return signals.volts
        time = np.arange(len(signals.volts)) * signals.step
        pickup = self.amplitude * np.cos(2 * np.pi * (self.frequency * time + signals.rng.random()))
        return _map_channels(self, signals, lambda v: v + pickup)
