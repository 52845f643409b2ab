"""Records with the contribution of nonlinear cell forces and nonlinear channels removed from the channels.

The cells measure these forces, and the model gives their effect on the channels; a nonlinear channel tells its own.
The linear response then describes the rest. The mean stays as the static calibration knows it, of cells and channels at
rest: only what vibration adds to the mean readings of nonlinear channels is removed from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import MemorySource, Run, read_channels
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.system import System
from balance_cli.model.system_response import solve
from balance_cli.signals.run_samples import sample_rate

Array = NDArray[np.float64]


def remove_nonlinear_contribution(run: Run, system: System, geometry: Geometry, live: Sequence[str]) -> Run:
    """The run without the dynamic contribution of nonlinear terms; the same run where there are none."""
    if not system.equations.has_nonlinear_terms:
        return run
    from balance_cli.estimation.cell_forces import record_cell_forces
    from balance_cli.estimation.channel_distortions import record_distortions, resting_distortions
    from balance_cli.signals.waveforms import record_waveform

    names = geometry.channel_names
    waveform = record_waveform(read_channels(run, live), sample_rate(run), live, geometry)
    solution = solve(system, waveform.frequency, run.rotor_speed)
    volts = record_cell_forces(waveform, system, solution).volts(system)
    volts[0] = 0.0
    volts = volts + record_distortions(waveform, system).volts(system)
    volts[0] -= waveform.mean_factor * resting_distortions(waveform, system)
    block = run.read()
    channels = block.channels.copy()
    for name in live:
        spectrum = np.zeros(run.samples // 2 + 1, complex)
        spectrum[: len(volts)] = volts[:, names.index(name)] * (run.samples / 2.0)
        channels[:, run.channel_names.index(name)] -= np.fft.irfft(spectrum, run.samples)
    return replace(run, source=MemorySource(channels, block.loads))
