"""Usable samples of a record: gaps, and channels that are bad for a part of the record only.

A sample is bad if it is missing (interpolated or not) or at the declared range of its channel. A channel that is bad in
a few short intervals is left out only there. Where all channels are bad at once the record has a gap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.channel_health import AT_RANGE, ChannelHealth
from balance_cli.campaign.recording.run import Run, read_channels
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.reduction.kalman.segments import Segment

Bits = NDArray[np.bool_]

MAX_BAD_SHARE = 0.2
"""Share of bad samples above which a channel is left out of the whole record: it is then more likely faulty."""
MAX_BAD_INTERVALS = 8
"""Bad intervals above which a channel is left out of the whole record: each costs filters for two more segments."""
MERGE_TIME = 0.25
"""Time [s] between two bad intervals below which they count as one: a filter hardly becomes steady in between."""
RECOVERY_TIME = 0.005
"""Time [s] after bad samples that is left out as well: the response time of the anti-alias filter."""
LONGEST_GAP = 1.0
"""Time [s] of the longest gap over which the model alone predicts the loads: 17 revolutions at 17.5 Hz."""


@dataclass(frozen=True)
class DataQuality:
    """Channels that are used, in the order of the geometry; segments of the record; gaps and lost channels in words."""

    names: tuple[str, ...]
    segments: tuple[Segment, ...]
    notes: tuple[str, ...]

    @property
    def spans(self) -> tuple[tuple[int, int], ...]:
        """Samples start to stop at which all used channels are good."""
        all_channels = tuple(range(len(self.names)))
        return tuple((s.start, s.stop) for s in self.segments if s.channels == all_channels)

    @property
    def gaps(self) -> tuple[Segment, ...]:
        """Segments without channels."""
        return tuple(s for s in self.segments if not s.channels)


def assess_data_quality(run: Run, geometry: Geometry, health: ChannelHealth) -> DataQuality:
    """Return the usable data of a record.

    Raises UserError where a gap is too long, or no segment has all channels.
    """
    assert run.sample_rate is not None
    declared = {channel.name: channel for channel in geometry.channels}
    present = [name for name in declared if name in run.channel_names]
    bridged = {item.name: item.index for item in run.bridged}
    doubtful = [name for name in present if name in health.left_out or name in bridged]
    limits = np.array([declared[name].range or np.inf for name in doubtful])
    bad = _bad_samples(run, doubtful, limits)
    for column, name in enumerate(doubtful):
        bad[bridged.get(name, np.empty(0, np.int64)), column] = True
    bad_intervals = [_bad_intervals(column, run.sample_rate) for column in bad.T]
    partly_bad = {
        name: intervals
        for name, intervals, column in zip(doubtful, bad_intervals, bad.T, strict=True)
        if 0 < column.mean() <= MAX_BAD_SHARE and len(intervals) <= MAX_BAD_INTERVALS
    }
    names = tuple(name for name in present if name in health.live or name in partly_bad)
    left_out = [(low, high, names.index(name)) for name, intervals in partly_bad.items() for low, high in intervals]
    segments = _segments(left_out, len(names), run.samples)
    _check_gaps(run, segments)
    _check_common_segment(run, names, segments)
    return DataQuality(names, segments, _notes(run, partly_bad, segments))


def _bad_samples(run: Run, names: Sequence[str], limits: NDArray[np.float64]) -> Bits:
    """Return which samples (n, c) are not finite or at the range."""
    parts = []
    for first in range(0, run.samples, 65536):
        y = read_channels(run, names, first, min(first + 65536, run.samples))
        parts.append(~np.isfinite(y) | (np.abs(y) >= AT_RANGE * limits))
    return np.concatenate(parts)


def _bad_intervals(bad: Bits, sample_rate: float) -> list[tuple[int, int]]:
    """Where (first, end) samples are bad, near ones joined and the recovery about each left out too."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], bad, [False]]).astype(int)))
    recovery, merge = int(np.ceil(RECOVERY_TIME * sample_rate)), MERGE_TIME * sample_rate
    intervals: list[tuple[int, int]] = []
    for low, high in edges.reshape(-1, 2):
        low, high = max(int(low) - 1, 0), min(int(high) + recovery, len(bad))
        if intervals and low - intervals[-1][1] < merge:
            intervals[-1] = (intervals[-1][0], high)
        else:
            intervals.append((low, high))
    return intervals


def _segments(left_out: Sequence[tuple[int, int, int]], count: int, samples: int) -> tuple[Segment, ...]:
    """Return the segments of `count` channels, of which (low, high, channel) are left out."""
    edges = sorted({0, samples, *(edge for low, high, _ in left_out for edge in (low, high))})
    missing = [{i for low, high, i in left_out if low <= edge < high} for edge in edges]
    changes = [0, *(k for k in range(1, len(edges) - 1) if missing[k] != missing[k - 1]), len(edges) - 1]
    return tuple(
        Segment(edges[a], edges[b], tuple(i for i in range(count) if i not in missing[a])) for a, b in pairwise(changes)
    )


def _check_gaps(run: Run, segments: Sequence[Segment]) -> None:
    assert run.sample_rate is not None
    place, most = run.file, max(len(s.channels) for s in segments)
    if most == 0:
        raise UserError("no channel is usable", place, "channels", "Repair the channels, or leave the run out")
    for gap in segments:
        length = (gap.stop - gap.start) / run.sample_rate
        if not gap.channels and length > LONGEST_GAP:
            at = f"from {gap.start / run.sample_rate:.3f} s on, {length:.3f} s long"
            fault = f"the record has a gap {at}; at most {LONGEST_GAP:g} s are possible"
            raise UserError(fault, place, "channels", "Reduce the parts before and after it as separate runs")


def _check_common_segment(run: Run, names: Sequence[str], segments: Sequence[Segment]) -> None:
    """Raise UserError unless some segment has all channels: noise and load models are estimated from such segments."""
    if not any(len(s.channels) == len(names) for s in segments):
        fault = "at no time are all channels good"
        raise UserError(fault, run.file, "channels", "Leave out the channels that are bad for long")


def _notes(run: Run, partly_bad: dict[str, list[tuple[int, int]]], segments: Sequence[Segment]) -> tuple[str, ...]:
    """Return the gaps and the intervals of lost channels, in words."""
    assert run.sample_rate is not None
    rate = run.sample_rate
    gaps = [s for s in segments if not s.channels]
    notes = [f"gap from {g.start / rate:.3f} to {g.stop / rate:.3f} s bridged" for g in gaps]
    for name, intervals in partly_bad.items():
        outside = [(a, b) for a, b in intervals if not any(g.start <= a and b <= g.stop for g in gaps)]
        if outside:
            times = ", ".join(f"{a / rate:.3f} to {b / rate:.3f} s" for a, b in outside)
            notes.append(f"channel {name} not used from {times}")
    return tuple(notes)
