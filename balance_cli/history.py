"""Load histories of a run: hub loads over time with sigma, and the file that holds them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from balance_cli.components import COMPONENTS, UNITS
from balance_cli.hub_loads import RunLoads
from balance_cli.runs import Run
from balance_cli.signals.azimuth import azimuth_from_pulses

Array = NDArray[np.float64]


@dataclass(frozen=True)
class History:
    """Hub loads over time: time (n,) [s from the first sample], loads and sigma (n, 6); NaN where not determined."""

    run: str
    time: Array
    loads: Array
    sigma: Array


def harmonic_history(run: Run, loads: RunLoads) -> History:
    """The sum of the harmonics of a steady run at the azimuth of each sample, over the interval that was used."""
    assert run.sample_rate is not None and run.pulse_times is not None
    time = np.arange(run.samples) / run.sample_rate
    time = time[(time >= loads.interval[0]) & (time < loads.interval[1])]
    psi = azimuth_from_pulses(run.pulse_times).psi(time)
    turns = np.exp(1j * psi[:, None] * np.arange(len(loads.frequency_hz)))
    mine = [COMPONENTS.index(name) for name in loads.components]
    values, sigma = np.full((2, len(time), 6), np.nan)
    values[:, mine] = np.real(turns @ loads.amplitude)
    variance = turns.real**2 @ loads.sigma_cosine**2 + turns.imag**2 @ loads.sigma_sine**2
    sigma[:, mine] = np.sqrt(variance)
    return History(run.name, time, values, sigma)


def write_history(path: Path, history: History) -> None:
    """HDF5 with `time` (n,), `loads` (n, 6), `sigma` (n, 6) (contract, LOADS)."""
    import h5py

    with h5py.File(path, "w") as file:
        file.attrs["format"] = "balance-history/1"
        file.attrs["run"] = history.run
        file.create_dataset("time", data=history.time).attrs["unit"] = "s"
        for name in ("loads", "sigma"):
            table = file.create_dataset(name, data=getattr(history, name), compression="gzip")
            table.attrs["names"] = COMPONENTS
            table.attrs["units"] = UNITS
