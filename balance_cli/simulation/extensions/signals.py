"""Effects in the measuring chain: changes of the channels' volts before the anti-alias filter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from balance_cli.io.errors import UserError
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
        """The volts shifted in time; before the record they are constant."""
        step = signals.step
        return _map_channels(self, signals, lambda v: v if step is None else filters.delay_signal(v, self.delay, step))


@dataclass(frozen=True)
class Saturation(Extension):
    """The channel reads the hyperbolic tangent of a linear one; it never exceeds 1 / sqrt(`compression` [1/V2])."""

    name: ClassVar[str] = "saturation"
    compression: float = 0.0

    def volts(self, signals: Signals) -> Array:
        """The compressed volts. Raises UserError for a negative compression."""
        if self.compression < 0.0:
            raise UserError(
                f"`{self.name}` needs `compression` of at least 0", place="effects", remedy="Give it in 1/V2"
            )
        if self.compression == 0.0:
            return signals.volts
        root = np.sqrt(self.compression)
        return _map_channels(self, signals, lambda v: np.tanh(root * v) / root)


@dataclass(frozen=True)
class ChannelNonlinearity(Extension):
    """The channel reads v = u + a u^2 for the volts u of a linear one, with `quadratic` a [1/V]."""

    name: ClassVar[str] = "channel-nonlinearity"
    quadratic: float = 0.0

    def volts(self, signals: Signals) -> Array:
        """The volts with their squares."""
        return _map_channels(self, signals, lambda u: u + self.quadratic * u * u)


@dataclass(frozen=True)
class LowPass(Extension):
    """A further first-order low-pass at `cutoff` [Hz]."""

    name: ClassVar[str] = "low-pass"
    cutoff: float = np.inf

    def volts(self, signals: Signals) -> Array:
        """The filtered volts; static readings are unchanged."""
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
        """The filtered volts; static readings are zero."""
        step = signals.step
        if self.cutoff == 0:
            return signals.volts
        tau = 1 / (2 * np.pi * self.cutoff)
        return _map_channels(
            self, signals, lambda v: np.zeros_like(v) if step is None else filters.high_pass(v, tau, step)
        )


@dataclass(frozen=True)
class ChannelGain(Extension):
    """The channel reads `gain` times its volts."""

    name: ClassVar[str] = "channel-gain"
    is_mixture: ClassVar[bool] = True
    gain: float = 1.0

    def volts(self, signals: Signals) -> Array:
        """The scaled volts."""
        return _map_channels(self, signals, lambda v: self.gain * v)


@dataclass(frozen=True)
class Crosstalk(Extension):
    """A `fraction` of the volts of the second channel is added to the first."""

    name: ClassVar[str] = "crosstalk"
    is_mixture: ClassVar[bool] = True
    fraction: float = 0.0

    def volts(self, signals: Signals) -> Array:
        """The volts with crosstalk."""
        to, source = self.pair(signals.names)
        volts = signals.volts.copy()
        volts[:, to] += self.fraction * volts[:, source]
        return volts


@dataclass(frozen=True)
class ChannelOffset(Extension):
    """The channel has an `offset` [V]."""

    name: ClassVar[str] = "channel-offset"
    is_mixture: ClassVar[bool] = True
    offset: float = 0.0

    def volts(self, signals: Signals) -> Array:
        """The volts with the offset."""
        return _map_channels(self, signals, lambda v: v + self.offset)


@dataclass(frozen=True)
class MainsPickup(Extension):
    """Mains interference: a sinusoid of `amplitude` [V] and `frequency` [Hz], with a different phase in each run."""

    name: ClassVar[str] = "mains-pickup"
    amplitude: float = 0.0
    frequency: float = 50.0

    def volts(self, signals: Signals) -> Array:
        """The volts with the tone, in phase in all channels; static readings are long enough to average it out."""
        if signals.step is None:
            return signals.volts
        time = np.arange(len(signals.volts)) * signals.step
        tone = self.amplitude * np.cos(2 * np.pi * (self.frequency * time + signals.rng.random()))
        return _map_channels(self, signals, lambda v: v + tone)
