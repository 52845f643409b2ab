"""The reading of the unloaded rig, from a wind-off record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import Calibration
from balance_cli.campaign.recording.run import Run, read_channels
from balance_cli.campaign.recording.temperature import mean_temperature
from balance_cli.campaign.rig.attitude import stated_gravity
from balance_cli.io.errors import UserError
from balance_cli.reduction.rotor_record import RotorRecord
from balance_cli.signals.distributions import student_widening
from balance_cli.signals.rotor.steadiness import sigma_if_steady, unsteady

Array = NDArray[np.float64]

ZERO_SEGMENTS = 16
"""Segments of a zero record. The scatter of their means gives the error of the whole mean, known to 18 % by so many."""
FEWEST_ZERO_SAMPLES = 3
"""Samples of a zero record: from two, Student's t widens the error of their mean thirteen times."""

ZERO_MEAN, FEWEST_WITHOUT_MEAN = 0.01, 4
"""Mean of a channel over the least standard deviation that its noise leaves it, up to which it was taken out, and
channels of which it must be so: four do so by chance of ten once in 10^6 records."""
BLOCK_SAMPLES = 65536
"""Samples that are read at a time."""


@dataclass(frozen=True)
class ZeroRecord:
    """Reading of the unloaded rig: means (c,) [V] of the named channels and their variance.

    `temperature` [degC]: mean of the record; `gravity` (3,): its direction in rig axes; None where it states none.
    `segments`: how many the variance is told by.
    """

    run: str
    channel_names: tuple[str, ...]
    mean: Array
    variance: Array
    temperature: float | None = None
    gravity: Array | None = None
    segments: int = ZERO_SEGMENTS


def zero_record(run: Run, channel_names: Sequence[str]) -> ZeroRecord:
    """Compute the means of a wind-off record, with their variance from the scatter of its segments, and their drift.

    Raises UserError for a record that is too short to have a scatter.
    """
    names = tuple(name for name in channel_names if name in run.channel_names)
    values = read_channels(run, names)
    if len(values) < FEWEST_ZERO_SAMPLES:
        fault = f"a zero of {len(values)} samples, whose scatter tells no error of the mean loads"
        raise UserError(fault, run.file, "channels", "Record the zero for some seconds, or leave the run out")
    segments = min(ZERO_SEGMENTS, len(values))
    means = np.array([part.mean(axis=0) for part in np.array_split(values, segments)])
    is_drift = unsteady(means.astype(complex), sigma_if_steady(means))  # either end may be the zero
    scatter = means.var(axis=0, ddof=1) / segments
    # Of a usual record this has been the variance itself; a few samples tell it less well.
    scatter *= student_widening(segments - 1.0) / student_widening(ZERO_SEGMENTS - 1.0)
    variance = scatter + (0.5 * np.ptp(means, axis=0) * is_drift) ** 2
    of_run = mean_temperature(run), stated_gravity(run.conditions)
    return ZeroRecord(run.name, names, values.mean(axis=0), variance, *of_run, segments)


def means_are_removed(record: RotorRecord, calibration: Calibration) -> bool:
    """Whether half of the channels of mean loads have means that are closer to zero than their noise permits."""
    calibrated = next(iter(calibration.trims.values())).channel_names
    names = [name for name in record.health.live if name in calibrated]
    if len(names) < FEWEST_WITHOUT_MEAN:
        return False
    run, spectrum = record.recorded or record.run, record.spectrum_over_time
    variance = spectrum.noise_variance(calibration.geometry.acquisition)[[spectrum.names.index(name) for name in names]]
    starts = range(0, run.samples, BLOCK_SAMPLES)
    sums = np.array([read_channels(run, names, start, start + BLOCK_SAMPLES).sum(axis=0) for start in starts])
    is_zero = np.abs(sums.sum(axis=0)) < ZERO_MEAN * np.sqrt(run.samples * variance)
    return int(np.count_nonzero(is_zero)) >= max(FEWEST_WITHOUT_MEAN, len(names) // 2)
