"""Short gaps of a record, samples that are not finite, held, dropped out or spikes, are bridged where it is read.

A gap is bridged by interpolation (`gap_interpolation`). Longer or more frequent gaps stay, and the channel is left out.
Gaps of the loads are faults of the run: loads are what responses and errors refer to, and no other signal can stand in
for them. Static runs have no time between their rows: an unread row is left out (`static_rows`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.false_samples import repeated_block, spikes
from balance_cli.campaign.recording.gap_interpolation import REACH, interpolate_missing
from balance_cli.campaign.recording.held_samples import ROTOR_KINDS, held_samples
from balance_cli.campaign.recording.run import LARGEST_MAGNITUDE, Array, BridgedSamples, Run, SampleBlock, SampleSource
from balance_cli.campaign.recording.static_rows import describe_rows, leave_out_rows
from balance_cli.io.result_view import plural

Integers = NDArray[np.int64]

LONGEST_GAP = 32
"""Samples of the longest gap that is bridged.

In broadband records the error of the interpolation grows from that of the noise (5 samples) to a tenth of the signal
(32 samples): beyond, the model of the signal, not the record, decides what stands there.
"""
LARGEST_SHARE = 0.01
"""Share of missing samples up to which gaps are bridged.

Even where nothing of the missing samples can be predicted, amplitudes then change by no more than the square root of
it, a tenth of their noise; a channel that loses more is faulty.
"""
BESIDE_GAP = 4
"""Samples beside other gaps whose edges look like spikes."""
CONTEXT = 1024
"""Samples on either side of a gap that the model is fitted to: ten for each of its coefficients."""
TILE = 2048
"""Samples whose gaps are filled at once."""


@dataclass(frozen=True)
class BridgedSource:
    """Samples of another source with gaps filled: `fills` {column of channels: (indices, values)}."""

    measured: SampleSource
    fills: Mapping[int, tuple[Integers, Array]]

    def read(self, start: int, stop: int) -> SampleBlock:
        """Return samples start to stop, filled."""
        block = self.measured.read(start, stop)
        channels = block.channels
        for column, (index, values) in self.fills.items():
            low, high = np.searchsorted(index, (start, stop))
            if low == high:
                continue
            channels = channels.copy() if channels is block.channels else channels
            channels[index[low:high] - start, column] = values[low:high]
        return replace(block, channels=channels)


def bridge_gaps(run: Run) -> Run:
    """Return the run with its short gaps filled, or its unread rows left out, and listed; itself where it has none."""
    if run.kind == "static":
        return leave_out_rows(run)
    bridged, faults = {}, {}
    missing, held = _missing_samples(run), held_samples(run)
    copied = repeated_block(run) if run.kind in ROTOR_KINDS else np.empty(0, np.int64)
    if len(copied):
        fault = f"samples {copied[0]} to {copied[-1]} repeat earlier ones in all channels: was a buffer written twice?"
        return replace(run, held=dict.fromkeys(run.channel_names, fault))
    single = spikes(run) if run.kind in ROTOR_KINDS and run.excitation != "impact" else {}
    for column in sorted({*missing, *held, *single}):
        known = np.union1d(missing.get(column, []), held.get(column, []))
        index = np.union1d(known, _apart(single.get(column, np.empty(0)), known)).astype(np.int64)
        name, count = run.channel_names[column], len(held.get(column, []))
        samples = _bridge(run, name, column, index) if len(index) <= LARGEST_SHARE * run.samples else None
        if samples is not None:
            bridged[column] = replace(samples, held=count, spikes=len(index) - len(known))
        elif count:
            faults[name] = _held_fault(held[column], run.samples)
    if not bridged and not faults:
        return run
    fills = {column: (samples.index, samples.values) for column, samples in bridged.items()}
    return replace(run, source=BridgedSource(run.source, fills), bridged=tuple(bridged.values()), held=faults)


def _apart(index: Array | Integers, known: Array | Integers) -> Array | Integers:
    """Return the spikes that are not the edge of another gap."""
    if not len(known):
        return index
    place = np.searchsorted(known, index)
    after, before = known[np.minimum(place, len(known) - 1)], known[np.maximum(place - 1, 0)]
    return index[np.minimum(np.abs(after - index), np.abs(index - before)) > BESIDE_GAP]


def _held_fault(index: Integers, samples: int) -> str:
    share = f"{len(index)} of {samples} samples repeat the one before or are exactly zero"
    return f"held or dropped out: {share}, the first is sample {index[0]}, more than can be bridged"


def gap_summary(run: Run) -> dict[str, dict[str, int]]:
    """Return how many samples of each signal were bridged, in how many gaps, and the samples of the longest one."""
    return {
        item.name: {
            "samples": item.count,
            "gaps": len(item.gaps),
            "longest": longest_gap(item.index),
            **({"held": item.held} if item.held else {}),
            **({"spikes": item.spikes} if item.spikes else {}),
        }
        for item in run.bridged
    }


def describe_gaps(run: Run) -> str:
    """Return the bridged gaps in words; empty without any."""
    if run.kind == "static":
        return describe_rows(run)
    texts = (
        f"{name} ({about['samples']} in {plural(about['gaps'], 'gap')}, longest {about['longest']}{_held_part(about)})"
        for name, about in gap_summary(run).items()
    )
    return f"missing samples interpolated: {', '.join(texts)}" if run.bridged else ""


def _held_part(about: Mapping[str, int]) -> str:
    held = f"; {about['held']} of them repeat a value or are exactly zero" if "held" in about else ""
    return held + (f"; {about['spikes']} of them are spikes" if "spikes" in about else "")


def report_gaps(runs: Iterable[Run], report: Callable[[str, str], None]) -> dict[str, dict[str, dict[str, int]]]:
    """Report the gaps of each run that has any in one sentence, and return their summaries by run."""
    with_gaps = [run for run in runs if run.bridged or run.copied_rows]
    for run in with_gaps:
        report(run.name, f"{run.name}: {describe_gaps(run)}")
    return {run.name: gap_summary(run) for run in with_gaps if run.bridged}


def longest_gap(index: Integers) -> int:
    """Return the length of the longest segment of consecutive samples among ascending indices."""
    return max(len(part) for part in _segments(index))


def _segments(index: Integers) -> list[Integers]:
    return np.split(index, np.flatnonzero(np.diff(index) > 1) + 1)


def _missing_samples(run: Run) -> dict[int, Integers]:
    """Return the indices of the missing samples of each column that has any, and not too many."""
    most, columns = int(LARGEST_SHARE * run.samples), len(run.channel_names)
    parts_by_column: list[list[Integers]] = [[] for _ in range(columns)]
    count = np.zeros(columns, int)
    for block in run.blocks():
        if np.isfinite(block.channels).all():
            continue
        bad = ~np.isfinite(block.channels)
        count += bad.sum(axis=0)
        for column in np.flatnonzero(bad.any(axis=0) & (count <= most)):
            parts_by_column[column].append(block.start + np.flatnonzero(bad[:, column]))
    return {
        column: np.concatenate(parts) for column, parts in enumerate(parts_by_column) if parts and count[column] <= most
    }


def _bridge(run: Run, name: str, column: int, missing: Integers) -> BridgedSamples | None:
    """Fill the missing samples of one column; None where a gap is too long or nothing is known around it."""
    if longest_gap(missing) > LONGEST_GAP:
        return None
    values, errors = [], []
    for first, stop in _tiles(missing):
        low, high = max(0, first - CONTEXT), min(run.samples, stop + CONTEXT + REACH)
        signal = run.read(low, high).channels[:, column]
        is_missing = ~np.isfinite(signal)
        is_missing[missing[slice(*np.searchsorted(missing, (low, high)))] - low] = True
        if np.any(np.abs(signal[~is_missing]) > LARGEST_MAGNITUDE):
            return None
        # Displaced gaps lie on the side where the record goes on.
        ends = high == run.samples and low + high < first + stop
        result = interpolate_missing(signal, is_missing, first - low, stop - low, ends)
        if result is None:
            return None
        values.append(result.values)
        errors.append(result.errors)
    return BridgedSamples(name, missing, np.concatenate(values), np.concatenate(errors, axis=1))


def _tiles(missing: Integers) -> Iterator[tuple[int, int]]:
    """Yield segments (first, stop) of at most TILE samples that hold all missing ones; no gap is divided."""
    gaps = [(int(part[0]), int(part[-1]) + 1) for part in _segments(missing)]
    first, stop = gaps[0]
    for begin, end in gaps[1:]:
        if end - first > TILE:
            yield first, stop
            first = begin
        stop = end
    yield first, stop
