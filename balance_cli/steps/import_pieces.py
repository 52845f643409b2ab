"""Files that continue each other in time: a record that the logger has split is one record again."""

from __future__ import annotations

from collections.abc import Callable, Sequence, Set
from dataclasses import replace
from itertools import pairwise

import numpy as np

from balance_cli.importers.base import Array, ChannelGroup, ForeignFile, ReadBlock
from balance_cli.io.errors import UserError

LARGEST_GAP = 0.5
"""Samples by which the clock of a piece may differ from the end of the one before: more is a sample too many or few."""


def joined_pieces(files: Sequence[ForeignFile], used: Set[str], time: str | None) -> Sequence[ForeignFile]:
    """The files of a run, as one where they have the same channels, `used` ones among them, and continue each other.

    The clock is the column `time` of the map, whose steps are checked where it is read, or that of the file.
    """
    if len(files) > 1 and any(used & set(group.names) for group in files[0].groups):
        joined = _join_files(files, time)
        return files if joined is None else [joined]
    return files


def _join_files(files: Sequence[ForeignFile], time: str | None) -> ForeignFile | None:
    """Files of the same channels as one, in the order of their clocks; None where these do not show that it is one."""
    if len({tuple((group.names, group.rate, group.stride) for group in file.groups) for file in files}) != 1:
        return None
    spans = [[_span(group, time) for group in file.groups] for file in files]
    if any(span is None for of_file in spans for span in of_file):
        return None
    order = sorted(range(len(files)), key=lambda place: spans[place][0] or (0.0, 0.0, 0.0))
    for k in range(len(files[0].groups)):
        known = [span for place in order if (span := spans[place][k]) is not None]
        if not all(_continues(one, other) for one, other in pairwise(known)):
            return None
    ordered = [files[place] for place in order]
    groups = tuple(
        _join([file.groups[k] for file in ordered], [str(file.path) for file in ordered])
        for k in range(len(files[0].groups))
    )
    names = ", ".join(file.path.name for file in ordered)
    note = f"{len(files)} files with the same channels continue each other, and are one record: {names}"
    labels = {name: _join_labels([file.labels[name] for file in ordered]) for name in ordered[0].labels}
    return replace(ordered[0], groups=groups, notes=(*ordered[0].notes, note), labels=labels)


def _span(group: ChannelGroup, time: str | None) -> tuple[float, float, float] | None:
    """First and last time of a group and the longest step to the next piece, in its own unit; None without a clock."""
    if group.rate is not None:
        return group.start, group.start + (group.samples - 1) / group.rate, (1.0 + LARGEST_GAP) / group.rate
    column = group.time if group.time is not None else group.names.index(time) if time in group.names else None
    if column is None or group.samples < 2:
        return None
    first, last = (float(group.read([column], at, at + 1)[0, 0]) for at in (0, group.samples - 1))
    return first, last, (1.0 + LARGEST_GAP) * (last - first) / (group.samples - 1)


def _continues(one: tuple[float, float, float], other: tuple[float, float, float]) -> bool:
    least = one[2] * (1.0 - LARGEST_GAP) / (1.0 + LARGEST_GAP)
    return bool(least <= other[0] - one[1] <= one[2])


def _join(pieces: Sequence[ChannelGroup], paths: Sequence[str]) -> ChannelGroup:
    ends = np.cumsum([group.samples for group in pieces])
    reads = [_named(group.read, path) for group, path in zip(pieces, paths, strict=True)]
    return replace(pieces[0], samples=int(ends[-1]), read=_read_through(reads, ends.tolist()))


def _named(read: ReadBlock, path: str) -> ReadBlock:
    """A reader whose errors name the file of the piece, not the first one of the record."""

    def named(columns: Sequence[int], start: int, stop: int) -> Array:
        try:
            return read(columns, start, stop)
        except UserError as error:
            raise error.with_location(file=path) from error

    return named


def _read_through(reads: Sequence[ReadBlock], ends: Sequence[int]) -> ReadBlock:
    """A reader of samples of all pieces, which end before the samples `ends` (p,)."""

    def read(columns: Sequence[int], start: int, stop: int) -> Array:
        blocks = [np.empty((0, len(columns)))]
        for piece, begin, end in zip(reads, [0, *ends[:-1]], ends, strict=True):
            if begin < stop and start < end:
                blocks.append(piece(columns, max(start, begin) - begin, min(stop, end) - begin))
        return np.concatenate(blocks)

    return read


def _join_labels(pieces: Sequence[Callable[[], tuple[str, ...]]]) -> Callable[[], tuple[str, ...]]:
    return lambda: tuple(label for piece in pieces for label in piece())
