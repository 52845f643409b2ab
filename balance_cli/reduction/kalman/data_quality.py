"""Which samples of which channels a filter can use: gaps, and channels that are bad for a part of the record only.

A sample is bad where it is not finite or at the channel's declared range. A channel that is bad for a small part of the
record, in few places, is left out there alone; where all channels are bad at once the record has a gap.
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
"""Of the record that a channel may be bad, or it is left out of all of it."""
MAX_BAD_INTERVALS = 8
"""Places in which a channel may be bad."""
MERGE_TIME = 0.25
"""Time [s] between two bad places below which they count as one: a filter hardly settles in between."""
RECOVERY_TIME = 0.005
"""Time [s] around bad samples that is left out too: filters of the acquisition remember them."""
LONGEST_GAP = 1.0
"""Time [s] over which loads are led on without a reading."""


@dataclass(frozen=True)
class DataQuality:
    """Channels that are used, in the geometry's order; stretches of the record; what was bridged, in words."""

    names: tuple[str, ...]
    segments: tuple[Segment, ...]
    notes: tuple[str, ...]

    @property
    def spans(self) -> tuple[tuple[int, int], ...]:
        """Samples start to stop where all of the channels are sound."""
        every = tuple(range(len(self.names)))
        return tuple((s.start, s.stop) for s in self.segments if s.channels == every)

    @property
    def gaps(self) -> tuple[Segment, ...]:
        """Where nothing is read."""
        return tuple(s for s in self.segments if not s.channels)


def assess_data_quality(run: Run, geometry: Geometry, health: ChannelHealth, start: int, stop: int) -> DataQuality:
    """What can be used of samples start to stop, `health` being that of the record as a whole.

    Raises UserError where a gap is too long to be bridged, or no stretch has all channels.
    """
    assert run.sample_rate is not None
    declared = {channel.name: channel for channel in geometry.channels}
    present = [name for name in declared if name in run.channel_names]
    doubtful = [name for name in present if name in health.left_out]
    limits = np.array([declared[name].range or np.inf for name in doubtful])
    bad = _bad_samples(run, doubtful, limits, start, stop)
    places = [_bad_intervals(column, run.sample_rate) for column in bad.T]
    partly_bad = {
        name: found
        for name, found, column in zip(doubtful, places, bad.T, strict=True)
        if 0 < column.mean() <= MAX_BAD_SHARE and len(found) <= MAX_BAD_INTERVALS
    }
    names = tuple(name for name in present if name in health.live or name in partly_bad)
    left_out = [(low, high, names.index(name)) for name, found in partly_bad.items() for low, high in found]
    segments = _segments(left_out, len(names), start, stop)
    _check_gaps(run, segments)
    _check_common_segment(run, names, segments)
    return DataQuality(names, segments, _notes(run, partly_bad, segments, start))


def _bad_samples(run: Run, names: Sequence[str], limits: NDArray[np.float64], start: int, stop: int) -> Bits:
    """Samples (n, c) that are not finite or at the range."""
    parts = []
    for first in range(start, stop, 65536):
        y = read_channels(run, names, first, min(first + 65536, stop))
        parts.append(~np.isfinite(y) | (np.abs(y) >= AT_RANGE * limits))
    return np.concatenate(parts)


def _bad_intervals(bad: Bits, sample_rate: float) -> list[tuple[int, int]]:
    """Where (first, end) samples are bad, near ones joined and the recovery about each left out too."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], bad, [False]]).astype(int)))
    recovery, joined = int(np.ceil(RECOVERY_TIME * sample_rate)), MERGE_TIME * sample_rate
    found: list[tuple[int, int]] = []
    for low, high in edges.reshape(-1, 2):
        low, high = max(int(low) - 1, 0), min(int(high) + recovery, len(bad))
        if found and low - found[-1][1] < joined:
            found[-1] = (found[-1][0], high)
        else:
            found.append((low, high))
    return found


def _segments(left_out: Sequence[tuple[int, int, int]], count: int, start: int, stop: int) -> tuple[Segment, ...]:
    """What is read of `count` channels, of which (low, high, channel), samples from `start` on, are left out."""
    edges = sorted({0, stop - start, *(edge for low, high, _ in left_out for edge in (low, high))})
    missing = [{i for low, high, i in left_out if low <= edge < high} for edge in edges]
    changes = [0, *(k for k in range(1, len(edges) - 1) if missing[k] != missing[k - 1]), len(edges) - 1]
    return tuple(
        Segment(start + edges[a], start + edges[b], tuple(i for i in range(count) if i not in missing[a]))
        for a, b in pairwise(changes)
    )


def _check_gaps(run: Run, segments: Sequence[Segment]) -> None:
    assert run.sample_rate is not None
    place, most = str(run.path or run.name), max(len(s.channels) for s in segments)
    if most == 0:
        raise UserError("no channel is left", place, "channels", "Mend the channels, or leave the run out")
    for gap in segments:
        length = (gap.stop - gap.start) / run.sample_rate
        if not gap.channels and length > LONGEST_GAP:
            at = f"from {gap.start / run.sample_rate:.3f} s on, {length:.3f} s long"
            fault = f"the record has a gap {at}; at most {LONGEST_GAP:g} s can be bridged"
            raise UserError(fault, place, "channels", "Reduce the parts before and after it as runs of their own")


def _check_common_segment(run: Run, names: Sequence[str], segments: Sequence[Segment]) -> None:
    """Noise and loads are first told by samples of all channels."""
    if not any(len(s.channels) == len(names) for s in segments):
        fault = "the channels are never sound at once"
        raise UserError(fault, str(run.path or run.name), "channels", "Leave out those that are bad for long")


def _notes(
    run: Run, partly_bad: dict[str, list[tuple[int, int]]], segments: Sequence[Segment], start: int
) -> tuple[str, ...]:
    """What was bridged."""
    assert run.sample_rate is not None
    rate = run.sample_rate
    gaps = [s for s in segments if not s.channels]
    notes = [f"gap from {g.start / rate:.3f} to {g.stop / rate:.3f} s bridged" for g in gaps]
    for name, found in partly_bad.items():
        alone = [(a, b) for a, b in found if not any(g.start <= start + a and start + b <= g.stop for g in gaps)]
        if alone:
            words = ", ".join(f"{(start + a) / rate:.3f} to {(start + b) / rate:.3f} s" for a, b in alone)
            notes.append(f"channel {name} not used from {words}")
    return tuple(notes)
