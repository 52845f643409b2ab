"""Recorded runs: their metadata, and their samples, whole or in blocks."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.additions import RunAdditions
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.io.result_view import plural

Array = NDArray[np.float64]

LARGEST_MAGNITUDE = 1e9
"""Of any sample, time or rate of a run in SI units. No rig comes near it, and fourth powers of it remain accurate."""


MOST_HELD_BYTES = 2**28
"""Of the samples of one run that are kept in memory: 256 MB, 20 channels at 10 kHz for 160 s. Longer ones are read in
blocks, as often as they are needed."""
MOST_HELD_TOGETHER = 2**27
"""Of the samples of the runs of a command, from which no further one is kept."""


@dataclass(frozen=True)
class SampleBlock:
    """Consecutive samples: `start` index, `channels` (m, n_channels) [V], `loads` (m, 6) [N, N m] or None."""

    start: int
    channels: Array
    loads: Array | None


class SampleSource(Protocol):
    """Source of the samples of a run: a file, or memory."""

    def read(self, start: int, stop: int) -> SampleBlock:
        """Return samples start to stop as float64, channels in the order of `Run.channel_names`."""
        ...


@dataclass(frozen=True)
class MemorySource:
    """Samples held in memory."""

    channels: Array
    loads: Array | None

    def read(self, start: int, stop: int) -> SampleBlock:
        """Return samples start to stop."""
        loads = None if self.loads is None else self.loads[start:stop]
        return SampleBlock(start, self.channels[start:stop], loads)

    @cached_property
    def channel_rows(self) -> Array:
        """The samples (n_channels, n), a row for each channel: transposed once for all tests that go by channels."""
        rows = np.ascontiguousarray(self.channels.T)
        rows.setflags(write=False)
        return rows


@dataclass(frozen=True)
class ExcerptSource:
    """Excerpt of another source, from its sample `start` on."""

    parent_source: SampleSource
    start: int

    def read(self, start: int, stop: int) -> SampleBlock:
        """Return samples start to stop of the excerpt."""
        block = self.parent_source.read(self.start + start, self.start + stop)
        return SampleBlock(start, block.channels, block.loads)


@dataclass(frozen=True)
class BridgedSamples:
    """Samples of one signal (channel or load) that were missing and are interpolated.

    `index` (m,), ascending, `values` (m,), and `errors` (k, m) of the same interpolation at k places beside them, where
    the samples are known. `held` of them are finite, but repeat the one before or are zeros of a link that dropped out;
    `spikes` of them are, too, but do not follow from their neighbors.
    """

    name: str
    index: NDArray[np.int64]
    values: Array
    errors: Array
    held: int = 0
    spikes: int = 0

    @property
    def count(self) -> int:
        """Number of missing samples."""
        return len(self.index)

    @property
    def gaps(self) -> tuple[tuple[int, int], ...]:
        """First sample and end of each gap."""
        parts = np.split(self.index, np.flatnonzero(np.diff(self.index) > 1) + 1)
        return tuple((int(part[0]), int(part[-1]) + 1) for part in parts)

    def excerpt(self, start: int, stop: int) -> BridgedSamples:
        """Return those of samples start to stop, counted from `start`."""
        low, high = np.searchsorted(self.index, (start, stop))
        part = slice(low, high)
        return replace(self, index=self.index[part] - start, values=self.values[part], errors=self.errors[:, part])


@dataclass(frozen=True, repr=False)
class Run:
    """One recorded run: its metadata, and its samples on demand.

    `excited` and `level` (rms in N or N m) are parallel tuples; `period` [s] where the excitation is periodic;
    `pulse_times` (n_rev,) [s from the first sample]; `attitude` (n, 2) of a static run: pitch and roll [deg] as in
    balance_cli.campaign.rig.attitude; `series_labels` and `point_kinds` (n,) of a static run: the load series of each
    row and the kind of its load point, None where the file states none; `digest` is the hex SHA-256 of the content;
    `bridged`: signals with short gaps, which `source` fills; in a static run those for which rows were left out;
    `held`: faults of channels with too many held samples, by name;
    `copied_rows`: rows of the file of a static run that were left out as copies.
    `conditions`: further numbers among the attributes of the file, such as the collective pitch or the wind speed, over
    which results can be compared. `reading_units`: base unit of each channel that is not read in V.
    """

    name: str
    rig: str
    kind: str
    channel_names: tuple[str, ...]
    samples: int
    source: SampleSource
    has_loads: bool = True
    sample_rate: float | None = None
    rotor_speed: float = 0.0
    excited: tuple[str, ...] = ()
    excitation: str | None = None
    level: tuple[float, ...] = ()
    period: float | None = None
    trim: str | None = None
    pulse_times: Array | None = None
    attitude: Array | None = None
    series_labels: tuple[str, ...] | None = None
    point_kinds: tuple[str, ...] | None = None
    recorded: str | None = None
    note: str | None = None
    path: Path | None = None
    digest: str = ""
    bridged: tuple[BridgedSamples, ...] = ()
    held: dict[str, str] = field(default_factory=dict)
    copied_rows: tuple[int, ...] = ()
    additions: RunAdditions | None = None
    conditions: dict[str, float] = field(default_factory=dict)
    reading_units: dict[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        channels = plural(len(self.channel_names), "channel")
        extent = plural(self.samples, "load point" if self.kind == "static" else "sample")
        rate = f" at {self.sample_rate:g} Hz" if self.sample_rate else ""
        return f"{self.kind.capitalize()} run {self.name} of rig {self.rig}: {channels}, {extent}{rate}"

    @property
    def file(self) -> str:
        """The file of the run, in which messages place a fault; its name where it has none."""
        return str(self.path or self.name)

    def read(self, start: int = 0, stop: int | None = None) -> SampleBlock:
        """Return samples start to stop (default: all) as one block."""
        return self.source.read(start, self.samples if stop is None else min(stop, self.samples))

    def blocks(self, size: int = 65536) -> Iterator[SampleBlock]:
        """Yield all samples, in blocks of at most `size`."""
        for start in range(0, self.samples, size):
            yield self.read(start, start + size)


def excerpt_run(run: Run, start: int, stop: int) -> Run:
    """Return samples start to stop of a sampled run as a run of its own, with the pulses that fall into it."""
    assert run.sample_rate is not None
    pulses = run.pulse_times
    if pulses is not None:
        pulses = pulses - start / run.sample_rate
        pulses = pulses[(pulses >= 0.0) & (pulses <= (stop - 1 - start) / run.sample_rate)]
    bridged = tuple(item for item in (signal.excerpt(start, stop) for signal in run.bridged) if item.count)
    return replace(
        run,
        samples=stop - start,
        source=ExcerptSource(run.source, start),
        pulse_times=pulses,
        bridged=bridged,
        additions=None if run.additions is None else run.additions.excerpt(start, stop, run.sample_rate),
    )


def hold_samples(run: Run) -> Run:
    """Return the run with its samples in memory, read once and write-protected; itself where they are too many."""
    columns = len(run.channel_names) + (len(COMPONENTS) if run.has_loads else 0)
    if isinstance(run.source, MemorySource) or 8 * run.samples * columns > MOST_HELD_BYTES:
        return run
    block = run.read()
    for samples in (block.channels, block.loads):
        if samples is not None:
            samples.setflags(write=False)
    return replace(run, source=MemorySource(block.channels, block.loads))


def held_bytes(run: Run) -> int:
    """Return the bytes of the samples that a run keeps in memory."""
    columns = len(run.channel_names) + (len(COMPONENTS) if run.has_loads else 0)
    return 8 * run.samples * columns if isinstance(run.source, MemorySource) else 0


def read_channels(run: Run, names: Sequence[str], start: int = 0, stop: int | None = None) -> Array:
    """Read samples (n, len(names)) [V] of these channels; a channel that the run does not have is NaN throughout."""
    return pick_channels(run.read(start, stop).channels, run.channel_names, names)


def read_channel_rows(run: Run, names: Sequence[str], start: int, stop: int | None) -> Array:
    """Read the same as rows (len(names), n) of consecutive numbers; not a copy where the run holds all of them so."""
    source = run.source
    if (
        isinstance(source, MemorySource)
        and not source.channels.flags.writeable
        and set(names) <= set(run.channel_names)
    ):
        stop = run.samples if stop is None else min(stop, run.samples)
        rows = source.channel_rows[:, start:stop]
        if tuple(names) == run.channel_names:
            return rows
        return np.asarray(rows[[run.channel_names.index(name) for name in names]])
    return np.ascontiguousarray(read_channels(run, names, start, stop).T)


def pick_channels(channels: Array, present: Sequence[str], names: Sequence[str]) -> Array:
    """Pick columns (n, len(names)) of `channels` (n, len(present)) in the order of `names`; NaN where one is absent.

    Not a copy where all are picked in their order.
    """
    if tuple(names) == tuple(present):
        return channels
    column = {name: index for index, name in enumerate(present)}
    selection = np.full((len(channels), len(names)), np.nan)
    available = [index for index, name in enumerate(names) if name in column]
    selection[:, available] = channels[:, [column[names[index]] for index in available]]
    return selection


def have_same_samples(first: Run, second: Run) -> bool:
    """Whether two runs are one recording, whatever their names; noise makes any two recordings differ at once."""
    if (first.samples, first.sample_rate, first.kind) != (second.samples, second.sample_rate, second.kind):
        return False
    common = [name for name in first.channel_names if name in second.channel_names]
    if not common:
        return False
    for a, b in zip(first.blocks(), second.blocks(), strict=True):
        samples = pick_channels(a.channels, first.channel_names, common)
        if not np.array_equal(samples, pick_channels(b.channels, second.channel_names, common), equal_nan=True):
            return False
    return True


_HASHED_APART = {"pulse_times", "attitude", "additions", "series_labels", "point_kinds", "conditions", "reading_units"}
_NOT_HASHED = {"source", "path", "digest", "bridged", "copied_rows"}
_DIGESTED_FIELDS = {item.name for item in fields(Run)} - _NOT_HASHED - _HASHED_APART


def run_digest(run: Run) -> str:
    """Return the hex SHA-256 of the metadata and of the samples as float64, independent of path and storage."""
    metadata = {name: getattr(run, name) for name in _DIGESTED_FIELDS}
    metadata["pulse_times"] = None if run.pulse_times is None else run.pulse_times.tolist()
    hashed = hashlib.sha256(json.dumps(metadata, sort_keys=True).encode())
    if run.attitude is not None:
        hashed.update(b"attitude" + np.ascontiguousarray(run.attitude, "<f8").tobytes())
    if run.additions is not None:
        hashed.update(b"additions" + run.additions.digest(run.samples))
    for name, labels in (("series", run.series_labels), ("point", run.point_kinds)):
        if labels is not None:
            hashed.update(json.dumps([name, labels]).encode())
    if run.conditions:
        hashed.update(json.dumps(["conditions", run.conditions], sort_keys=True).encode())
    if run.reading_units:
        hashed.update(json.dumps(["reading_units", run.reading_units], sort_keys=True).encode())
    for block in run.blocks():
        hashed.update(np.ascontiguousarray(block.channels, "<f8").data)
        if block.loads is not None:
            hashed.update(np.ascontiguousarray(block.loads, "<f8").data)
    return hashed.hexdigest()
