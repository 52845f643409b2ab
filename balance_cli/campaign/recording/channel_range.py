"""Samples that no sensor of the rig can have given: the sign of a wrong unit or a wrong sensitivity."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from balance_cli.campaign.recording.run import Array, Run, read_channels
from balance_cli.campaign.rig.channel import Channel
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError

BEYOND_FULL_RANGE = 5.0
"""Times the full range of a cell. Cells break at three to five times; millivolts taken for volts give a thousand."""
TYPICAL_QUANTILE = 0.5
"""Of the magnitudes of a channel: half of the samples must lie beyond, so that spikes and shocks do not count."""


def full_range_faults(run: Run, geometry: Geometry) -> Iterator[UserError]:
    """Yield a fault for each channel that reads far more than the full range of its cell gives."""
    limits = {channel.name: _largest_reading(channel, geometry) for channel in geometry.channels}
    names = [name for name, limit in limits.items() if limit is not None and name in run.channel_names]
    typical = _typical_magnitudes(run, names)
    for name, magnitude in zip(names, typical, strict=True):
        limit = limits[name]
        assert limit is not None
        if magnitude > BEYOND_FULL_RANGE * limit:
            fault = f"reads {magnitude:.3g} V, {magnitude / limit:.3g} times what the full range of its cell gives"
            remedy = "Are the samples in mV, or is the sensitivity in the geometry of another unit?"
            yield UserError(fault, run.file, f"channel {name}", remedy)


def _largest_reading(channel: Channel, geometry: Geometry) -> float | None:
    """The reading at full range of its cells [V], None for a channel of no cell."""
    ranges = {cell.name: cell.full_range for cell in geometry.cells}
    if not channel.cell_weights:
        return None
    return abs(channel.sensitivity) * sum(abs(weight) * ranges[name] for name, weight in channel.cell_weights.items())


def _typical_magnitudes(run: Run, names: list[str]) -> Array:
    """Median over blocks of the median magnitude of each channel (n,) [V]."""
    if not names:
        return np.empty(0)
    size = 65536
    blocks = (read_channels(run, names, start, start + size) for start in range(0, run.samples, size))
    medians = [np.quantile(np.abs(block), TYPICAL_QUANTILE, axis=0) for block in blocks]
    return np.asarray(np.median(medians, axis=0), float)
