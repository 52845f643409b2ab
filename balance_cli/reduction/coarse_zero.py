"""The zero of a wind-off record whose noise is below one step of the converter, so that no channel moves in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run, read_channels
from balance_cli.campaign.recording.temperature import mean_temperature
from balance_cli.campaign.rig.attitude import stated_gravity
from balance_cli.reduction.wind_off import ZeroRecord
from balance_cli.signals.quantization import is_on_grid

Array = NDArray[np.float64]

MOST_SAMPLES = 65536
"""Samples of a record that show the steps of its converter."""
SAMPLES_PER_VALUE = 10
"""Samples for each distinct value, at least: a converter that is not coarse hardly repeats one."""


def coarse_zero(zero: Run, record: Run, channel_names: Sequence[str]) -> ZeroRecord | None:
    """Return the zero of those named channels of a run that are constant, by the converter's steps in a `record`.

    Any reading within half a step gives the same value, so that the variance is the square of the step over 12 (Widrow
    and Kollar, Quantization Noise, 2008, chapter 4); no average makes it smaller. Returns None where the record shows
    no steps, where a channel has none of its values, and where all are 0 V, as of an amplifier without power.
    """
    names = [name for name in channel_names if name in zero.channel_names and name in record.channel_names]
    quiet = read_channels(zero, names)
    names = [name for name, extent in zip(names, np.ptp(quiet, axis=0), strict=True) if extent == 0.0]
    level, values = read_channels(zero, names)[0], read_channels(record, names, 0, min(MOST_SAMPLES, record.samples))
    steps = np.array([converter_step(column) for column in values.T])
    if not level.any() or not np.all(steps > 0) or not np.all(is_on_grid((level - values[0]) / steps)):
        return None
    return ZeroRecord(
        zero.name, tuple(names), level, steps**2 / 12.0, mean_temperature(zero), stated_gravity(zero.conditions)
    )


def join_zeros(first: ZeroRecord, second: ZeroRecord) -> ZeroRecord:
    """Return the zero of the channels of both, from one run."""
    mean, variance = (np.concatenate(pair) for pair in ((first.mean, second.mean), (first.variance, second.variance)))
    return replace(first, channel_names=(*first.channel_names, *second.channel_names), mean=mean, variance=variance)


def converter_step(values: Array) -> float:
    """Return the step [V] between the values (n,) of a channel; zero where they are not few and evenly spaced."""
    distinct = np.unique(values)
    if not 1 < len(distinct) <= len(values) / SAMPLES_PER_VALUE:
        return 0.0
    gaps = np.diff(distinct)
    step = float(gaps.min())
    return step if np.all(is_on_grid(gaps / step)) else 0.0
