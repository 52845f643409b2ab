"""Noise of the measuring chain, as in the recorded campaign."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.channel import Channel
from balance_cli.campaign.rig.declared_values import FrozenModel, Name, Positive

Array = NDArray[np.float64]

LARGEST_NOISE = 1e6
"""Factor on the noise of the recorded campaign; with it every signal is buried."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations of independent white Gaussian noise, added behind the anti-alias filter.

    Defaults are those of the recorded campaign of the rig RTS-6, estimated from the differences between the last four
    periods of its sweeps: strain channels 1.00 mV (0.99 to 1.01), piezo channels 1.50 mV, torque 2.00 mV, excited load
    signals 0.020 N or N m, all white from 5 Hz to the Nyquist frequency (the same density within 3 % in the bands 5 to
    50, 50 to 150, 220 to 300 and 300 to 399 Hz, so it does not pass the 200 Hz filter). Below 2 Hz the piezo channels
    only appear noisier: there the start transient of their 3 s time constant has not decayed. Channels are rounded to
    `quantum` = 20 V / 2^16, loads are not. Static readings: 0.2 mV and 0.05 N or N m, not rounded. Load signals and
    static loads that are not applied are exactly zero. The pulses carry no noise. All data are stored in single
    precision.
    """

    strain: float = 1.0e-3
    piezo: float = 1.5e-3
    torque: float = 2.0e-3
    load: float = 0.02
    static_channel: float = 2.0e-4
    static_load: float = 0.05
    quantum: float = 20.0 / 2**16
    single_precision: bool = True

    def scale_by(self, factor: float) -> Noise:
        """The noise multiplied by `factor`; with 0 rounding is left out, too."""
        return replace(
            self,
            strain=self.strain * factor,
            piezo=self.piezo * factor,
            torque=self.torque * factor,
            load=self.load * factor,
            static_channel=self.static_channel * factor,
            static_load=self.static_load * factor,
            quantum=self.quantum if factor else 0.0,
            single_precision=self.single_precision and factor != 0,
        )

    def sigma_of_channel(self, channel: Channel) -> float:
        """Standard deviation [V] of a channel in a record."""
        if channel.torque_meter:
            return self.torque
        return self.strain if channel.measures_dc else self.piezo

    def quantize(self, volts: Array) -> Array:
        """Volts as the converter outputs them."""
        return np.round(volts / self.quantum) * self.quantum if self.quantum else volts

    def to_file_precision(self, values: Array) -> Array:
        """Values as a run file of this precision stores them."""
        return values.astype(np.float32).astype(np.float64) if self.single_precision else values


class DeclaredNoise(FrozenModel):
    """Standard deviations of a sample: of the channels [V] by kind or by name, and of the load signals [N, N m]."""

    strain: Positive | None = None
    piezo: Positive | None = None
    torque: Positive | None = None
    load: Positive | None = None
    channels: Mapping[Name, Positive] = {}


NO_NOISE = Noise().scale_by(0.0)
