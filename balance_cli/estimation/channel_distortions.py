"""What channels that are not linear read beyond linear ones, computed from their own readings.

A channel that saturates maps the voltage of a linear one to another, one to one. So the difference of the two is a
known function of the reading, whose spectrum is subtracted from the channel's lines. Like a nonlinear force it acts at
all frequencies at once, the mean included. The reading counts from the zero of the channel; that the distortion depends
on an offset is not among the derivatives, for it is small beside the offset itself.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import ChannelDistortion
from balance_cli.model.system import System
from balance_cli.signals.waveform_types import Waveform

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

# Rms of a distortion over that of the reading it is computed from: a channel that is beyond it tells next to nothing of
# the force, and at a share of one the reading would explain itself.
MAX_SHARE = 0.5

_AT_NULL: WeakKeyDictionary[Waveform, dict[Hashable, tuple[ComplexArray, ComplexArray]]] = WeakKeyDictionary()
"""By waveform, the distortions of zero strength with their derivatives, which every scoring asks for again."""


@dataclass(frozen=True)
class DistortionAtLines:
    """The distortion (k,) [V] of one channel, and its derivatives (k, q) by the parameters `columns` (q,)."""

    channel: int
    volts: ComplexArray
    columns: Index
    derivative: ComplexArray


@dataclass(frozen=True)
class RunDistortions:
    """The distortions of all channels in one run, at its `lines` in its batch."""

    lines: slice
    count: int
    distortions: tuple[DistortionAtLines, ...]

    def volts(self, system: System) -> ComplexArray:
        """Volts (k, c) that the channels read beyond linear ones."""
        total = np.zeros((self.count, len(system.equations.paths)), complex)
        for item in self.distortions:
            total[:, item.channel] += item.volts
        return total

    def add_derivatives(self, system: System, total: ComplexArray) -> None:
        """Add the derivatives of the volts to `total` (k, c, p), in place."""
        for item in self.distortions:
            total[:, item.channel, item.columns] += item.derivative


def channel_distortions(batch: Batch, system: System, derivatives: bool) -> tuple[RunDistortions, ...]:
    """Compute the distortions in every run of a batch whose channels are known through time.

    Raises LinAlgError where a channel reads more than it can, or a distortion is most of its reading.
    """
    if not system.equations.distortions:
        return ()
    return tuple(
        _run_distortions(run.lines, run.waveform, system, derivatives) for run in batch.runs if run.waveform is not None
    )


def record_distortions(waveform: Waveform, system: System) -> RunDistortions:
    """Compute the distortions of one record at all frequencies of its waveform, without derivatives."""
    return _run_distortions(slice(None), waveform, system, derivatives=False)


def resting_distortions(waveform: Waveform, system: System) -> Array:
    """Compute the volts (c,) by which channels that are not linear read differently at rest, under the mean loads.

    The mean of what they read differently in a vibration is another one.
    """
    total = np.zeros(len(system.equations.paths))
    for item in system.equations.distortions:
        if item.values.value[0] != 0.0:
            reading = waveform.to_time_domain(waveform.volts[:, item.channel])
            total[item.channel] += _distortion_at_rest(
                item, reading - system.equations.channel_offset.value[item.channel]
            )
    return total


def _distortion_at_rest(item: ChannelDistortion, reading: Array) -> float:
    """The distortion [V] at the mean of the linear reading, which lies between those of the least and the largest."""
    from scipy.optimize import brentq

    values = Dual(item.values.value, np.zeros((0, len(item.values.value))))

    def linear(v: Array) -> Array:
        return np.asarray(v - (values[0] * item.shape(v, values)).value)

    mean = linear(reading).mean()
    if np.ptp(reading) == 0.0:  # a channel that is left out reads its zero throughout
        return float(reading[0] - mean)
    at_rest = brentq(lambda v: linear(np.array([v]))[0] - mean, reading.min(), reading.max())
    return float(at_rest - mean)


def _run_distortions(lines: slice, waveform: Waveform, system: System, derivatives: bool) -> RunDistortions:
    offset = system.equations.channel_offset.value
    distortions = tuple(
        _at_lines(item, float(offset[item.channel]), waveform, derivatives) for item in system.equations.distortions
    )
    count = len(waveform.combine_bins(np.zeros(len(waveform.bin_frequency()), complex)))
    return RunDistortions(lines, count, distortions)


def _at_lines(item: ChannelDistortion, offset: float, waveform: Waveform, derivatives: bool) -> DistortionAtLines:
    columns = np.flatnonzero(np.any(item.values.derivative, axis=1)) if derivatives else np.zeros(0, np.intp)
    volts, by_values = _volts_and_slopes(item, offset, waveform, len(columns) > 0)
    return DistortionAtLines(item.channel, volts, columns, by_values @ item.values.derivative[columns].T)


def _volts_and_slopes(
    item: ChannelDistortion, offset: float, waveform: Waveform, derivatives: bool
) -> tuple[ComplexArray, ComplexArray]:
    """The distortion (k,) [V] at the lines, and its derivatives (k, v) by its own values, zero where not asked for.

    At the null both follow from the reading and its zero alone: they are kept as long as the waveform.
    """
    if item.values.value[0] != 0.0:
        return _transform_distortion(item, offset, waveform, derivatives)
    key = (item.channel, item.shape, item.values.value.tobytes(), offset, derivatives)
    of_waveform = _AT_NULL.setdefault(waveform, {})
    if key not in of_waveform:
        of_waveform[key] = _transform_distortion(item, offset, waveform, derivatives)
    return of_waveform[key]


def _transform_distortion(
    item: ChannelDistortion, offset: float, waveform: Waveform, derivatives: bool
) -> tuple[ComplexArray, ComplexArray]:
    count = len(item.values.value)
    reading = waveform.to_time_domain(waveform.volts[:, item.channel]) - offset
    values = Dual(item.values.value, np.eye(count) if derivatives else np.zeros((0, count)))
    distortion = values[0] * item.shape(reading, values)
    if not np.linalg.norm(distortion.value) <= MAX_SHARE * np.linalg.norm(reading):
        raise np.linalg.LinAlgError("the distortion of a channel is most of its reading")
    volts = waveform.combine_bins(waveform.to_bins(distortion.value))
    if not derivatives:
        return volts, np.zeros((len(volts), count), complex)
    return volts, waveform.combine_bins(waveform.to_bins(distortion.derivative.T))
