"""From forces to recorded volts: sensitivity, each channel's own dynamics, the anti-alias filter.

Every filter starts in equilibrium with its first sample, as after a long time under the first load.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.simulation.filters import high_pass, low_pass
from balance_cli.simulation.rig import TrueRig

Array = NDArray[np.float64]


def sensor_volts(rig: TrueRig, forces: Array, step: float | None) -> Array:
    """Volts (n, channels) before the acquisition, from what the sensors measure, sampled every `step` s.

    `forces` (n, cells+t+a) are those of the cells, the torques, and the accelerations [m/s2] at the accelerometers.
    Without a `step` the rows are readings at rest: the output of a high-pass is zero.
    """
    geometry = rig.geometry
    volts = np.empty((len(forces), len(geometry.channels)))
    weights = sensor_weights(geometry)
    for i, (channel, sensitivity) in enumerate(zip(geometry.channels, rig.sensitivities, strict=True)):
        signal = forces @ weights[i] * sensitivity
        if channel.lowpass is not None and step is not None:
            signal = low_pass(signal, channel.lowpass, step)
        if channel.time_constant is not None:
            signal = high_pass(signal, channel.time_constant, step) if step is not None else np.zeros(len(signal))
        volts[:, i] = signal
    return volts


def sensor_weights(geometry: Geometry) -> Array:
    """Weights (channels, cells+t+a) of the sensors in each channel's reading."""
    accelerometers = [i for i, channel in enumerate(geometry.channels) if channel.accelerometer is not None]
    cells, meters = len(geometry.cells), [meter.name or True for meter in geometry.shaft_meters]
    weights = np.zeros((len(geometry.channels), cells + len(meters) + len(accelerometers)))
    for i, channel in enumerate(geometry.channels):
        for name, weight in channel.cell_weights.items():
            weights[i, geometry.cell_names.index(name)] = weight
        if channel.torque_meter:
            weights[i, cells + meters.index(channel.torque_meter)] = 1.0
    weights[accelerometers, cells + len(meters) + np.arange(len(accelerometers))] = 1.0
    return weights
