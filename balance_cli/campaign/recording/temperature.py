"""Temperature of a run: of its dataset, one value for each row, or of its attribute, one value for the whole run."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.additions import BLOCK, TEMPERATURE, MemoryAdditions, RunAdditions
from balance_cli.campaign.recording.run import Run

Array = NDArray[np.float64]

TEMPERATURE_ATTRIBUTE = "temperature"
"""Root attribute of a run file [degC]."""


def run_temperature(run: Run, start: int = 0, stop: int | None = None) -> Array | None:
    """Temperature (m,) [degC] of samples start to stop, the mean of the sensors that are connected; None if unknown."""
    stop = run.samples if stop is None else min(stop, run.samples)
    if run.additions is not None and run.additions.temperature_names:
        rows = np.vstack(
            [run.additions.read(TEMPERATURE, at, min(at + BLOCK, stop)) for at in range(start, stop, BLOCK)]
        )
        known = np.isfinite(rows).any(axis=0)
        mean = rows[:, known].mean(axis=1) if known.any() else np.full(len(rows), np.nan)
        return np.asarray(mean) if np.isfinite(mean).all() else None
    value = run.conditions.get(TEMPERATURE_ATTRIBUTE)
    return None if value is None else np.full(stop - start, value)


def mean_temperature(run: Run, start: int = 0, stop: int | None = None) -> float | None:
    """Mean temperature [degC] of samples start to stop; None if unknown."""
    values = run_temperature(run, start, stop)
    return None if values is None or not len(values) else float(values.mean())


def temperature_addition(values: Array) -> RunAdditions:
    """The temperature (n,) [degC] of each row as an addition to a run."""
    source = MemoryAdditions({TEMPERATURE: np.asarray(values, float)[:, None]})
    return RunAdditions(temperature_names=(TEMPERATURE,), source=source)
