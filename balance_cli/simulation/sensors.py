"""From forces to recorded volts: sensitivity, each channel's own dynamics, the anti-alias filter.

Every filter starts in equilibrium with its first sample, as after a long time under the first load.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.simulation.filters import high_pass, low_pass
from balance_cli.simulation.rig import TrueRig

Array = NDArray[np.float64]


def sensor_volts(rig: TrueRig, forces: Array, step: float | None) -> Array:
    """Volts (n, channels) before the acquisition, from cell forces and torque (n, cells+1) sampled every `step` s.

    Without a `step` the rows are readings at rest: the output of a high-pass is zero.
    """
    geometry = rig.geometry
    volts = np.empty((len(forces), len(geometry.channels)))
    for i, (channel, sensitivity) in enumerate(zip(geometry.channels, rig.sensitivities, strict=True)):
        source = -1 if channel.cell is None else geometry.cell_names.index(channel.cell)
        signal = forces[:, source] * sensitivity
        if channel.lowpass is not None and step is not None:
            signal = low_pass(signal, channel.lowpass, step)
        if channel.time_constant is not None:
            signal = high_pass(signal, channel.time_constant, step) if step is not None else np.zeros(len(signal))
        volts[:, i] = signal
    return volts
