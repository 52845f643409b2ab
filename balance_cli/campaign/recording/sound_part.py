"""The longest part of a record in which no channel is lost: not finite, or constant, for longer than can be bridged."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.channel_health import LEAST_FLATLINE
from balance_cli.campaign.recording.gaps import bridge_gaps
from balance_cli.campaign.recording.run import Run, excerpt_run, read_channel_rows
from balance_cli.campaign.recording.silent_segment import silent_segments

Mask = NDArray[np.bool_]

FEWEST_SHARE = 0.2
"""Of a record, that is left, below which a channel is not lost for a while but faulty."""
BLOCK = 65536
"""Samples that are read at a time."""


@dataclass(frozen=True)
class SoundPart:
    """Samples `start` to `stop` of a run as a run of its own, which begins `offset` [s] after the first sample."""

    run: Run
    start: int
    stop: int
    offset: float


def longest_sound_part(run: Run, channels: Iterable[str]) -> SoundPart | None:
    """Return the longest part of a sampled run in which none of these channels is lost; None where little is left.

    None also where no channel is lost: another fault keeps them from being used.
    """
    lost, channels = np.zeros(run.samples, bool), set(channels)
    for name in channels:
        if name in run.channel_names:
            lost |= _lost_samples(run, name)
    for name, (first, last) in silent_segments(run, run.channel_names).items():
        if name in channels:
            lost[first : last + 1] = True
    if not lost.any() or run.sample_rate is None:
        return None
    edges = np.flatnonzero(np.diff(np.concatenate([[True], lost, [True]]).astype(np.int8)))
    starts, stops = edges[::2], edges[1::2]
    if not len(starts):
        return None
    k = int(np.argmax(stops - starts))
    start, stop = int(starts[k]), int(stops[k])
    if stop - start < FEWEST_SHARE * run.samples:
        return None
    part = excerpt_run(run, start, stop)
    bridged = bridge_gaps(replace(part, held={}))  # single held samples are bridged where the long stretch is away
    bridged = replace(bridged, bridged=tuple({item.name: item for item in (*part.bridged, *bridged.bridged)}.values()))
    return SoundPart(bridged, start, stop, start / run.sample_rate)


def _lost_samples(run: Run, name: str) -> Mask:
    """Return which samples (n,) of a channel are not finite, or in a stretch of equal ones that no sound sensor has."""
    parts = [read_channel_rows(run, [name], start, start + BLOCK)[0] for start in range(0, run.samples, BLOCK)]
    values = np.concatenate(parts)
    lost = ~np.isfinite(values)
    equal = np.concatenate([[False], values[1:] == values[:-1], [False]])
    edges = np.flatnonzero(np.diff(equal.astype(np.int8)))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        if last - first >= LEAST_FLATLINE:
            lost[first : last + 1] = True
    return np.asarray(lost)
