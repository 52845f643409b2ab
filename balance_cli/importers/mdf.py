"""MDF files of ASAM, version 4 (and 3), read in blocks by asammdf."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from balance_cli.importers.base import (
    Array,
    ChannelGroup,
    ForeignChannel,
    ForeignFile,
    TextLayout,
    damage_error,
    errors_as_damage,
    impossible_size,
    require_package,
)
from balance_cli.importers.time_axis import read_time_axis
from balance_cli.io.errors import UserError
from balance_cli.io.reader_process import read_in_child

NAME = "MDF"
IDENTIFICATION = 64
"""Bytes of the identification block, which the header block follows."""
ALL_INVALID = 1
"""Flag of a channel of MDF 4 without a valid value (ASAM MDF 4.1, block CN); of MDF 3 it has none."""
SIGNATURES = (b"MDF     ", b"UnFinMF ")


def sniff(path: Path, head: bytes) -> bool:
    """Whether it begins with the identification of an MDF file."""
    return head[:8] in SIGNATURES


def open_file(path: Path, layout: TextLayout) -> ForeignFile:
    """List the channels of every channel group; the rate is that of its master channel."""
    require_package("asammdf", "MDF4", "asammdf")
    with path.open("rb") as stream:
        if stream.read(IDENTIFICATION + 4)[IDENTIFICATION:][:2] not in (b"##", b"HD"):
            raise damage_error("no header block behind the identification")
    listed, recorded = _list_groups(path)
    if not listed:
        raise UserError("has no channels with samples", remedy="Give a file with channels")
    return ForeignFile(path, NAME, tuple(_group(path, item) for item in listed), recorded=recorded)


@dataclass(frozen=True)
class _Listed:
    """A channel group: its index, its channels with their positions in it, samples, rate [Hz] and start [s]."""

    index: int
    channels: tuple[ForeignChannel, ...]
    positions: tuple[int, ...]
    samples: int
    rate: float | None
    start: float
    unusable: str


@read_in_child
def _list_groups(path: Path) -> tuple[list[_Listed], str | None]:
    """The channel groups with samples, and the time of recording; in a child, since damaged files end asammdf."""
    from asammdf import MDF

    with errors_as_damage(), path.open("rb") as stream, MDF(stream) as file:
        begin = file.header.start_time
        listed = [_listed(path, file, index) for index in range(len(file.groups))]
    return [item for item in listed if item is not None], begin.isoformat(timespec="seconds") if begin else None


def _listed(path: Path, file: Any, index: int) -> _Listed | None:
    """The numeric channels of a channel group; one whose time steps differ cannot be used."""
    group = file.groups[index]
    master = file.masters_db.get(index)
    samples = int(group.channel_group.cycles_nr)
    names = [(k, channel) for k, channel in enumerate(group.channels) if k != master]
    if samples < 2 or not names:
        return None
    unusable, rate, start = impossible_size(path, samples, len(names)), None, 0.0
    if master is not None and not unusable:
        try:
            axis = read_time_axis(lambda _, first, last: _times(file, index, first, last), samples)
            rate, start = axis.rate, axis.start
        except UserError as error:
            unusable = f"sampled at uneven times ({error.fault})"
    channels = tuple(ForeignChannel(channel.name, _unit(channel)) for _, channel in names)
    return _Listed(index, channels, tuple(k for k, _ in names), samples, rate, start, unusable)


def _times(file: Any, index: int, first: int, last: int) -> Array:
    """Records first to last of the master channel of a group. Raises ValueError where there are fewer."""
    stamps = np.asarray(file.get_master(index, record_offset=first, record_count=last - first), np.float64)
    if len(stamps) != last - first:
        raise ValueError(f"{len(stamps)} times from record {first} on, where {last - first} are declared")
    return stamps[:, None]


def _group(path: Path, listed: _Listed) -> ChannelGroup:
    def read(columns: Sequence[int], first: int, last: int) -> Array:
        positions = [listed.positions[k] for k in columns]
        distinct = list(dict.fromkeys(positions))
        values = _load_rows(path, listed.index, distinct, first, last)
        return values if distinct == positions else values[:, [distinct.index(position) for position in positions]]

    return ChannelGroup(listed.channels, listed.samples, read, listed.rate, listed.start, listed.unusable)


def _unit(channel: Any) -> str:
    conversion = getattr(channel, "conversion", None)
    return str(getattr(channel, "unit", "") or getattr(conversion, "unit", "") or "")


@read_in_child
def _load_rows(path: Path, index: int, positions: Sequence[int], first: int, last: int) -> Array:
    """Records first to last of some channels of a group, which asammdf selects together without reading the others.

    From an open stream it reads the blocks of these records; given a path it reads all blocks of a long record.
    """
    from asammdf import MDF

    with errors_as_damage(path), path.open("rb") as stream, MDF(stream) as file:
        wanted = [(None, index, position) for position in positions]
        signals = file.select(wanted, record_offset=first, record_count=last - first, copy_master=False)
        columns = [(np.asarray(signal.samples), _are_invalid(file, signal)) for signal in signals]
    table = np.empty((last - first, len(columns)), order="F")  # column by column, as they come
    for (values, are_invalid), column in zip(columns, table.T, strict=True):
        if values.dtype.kind not in "iufb" or values.ndim != 1:
            raise UserError("a channel holds no real numbers", str(path), remedy="Leave it out of the map")
        if len(values) != last - first:
            raise damage_error(f"{len(values)} records from {first} on, where {last - first} are declared")
        column[:] = values
        column[are_invalid] = np.nan
    return table


def _are_invalid(file: Any, signal: Any) -> NDArray[np.bool_]:
    """Which samples the recorder has marked as no values: by a bit of each record, or by a flag of the channel."""
    channel = file.groups[signal.group_index].channels[signal.channel_index]
    if getattr(channel, "flags", 0) & ALL_INVALID:
        return np.ones(len(signal.samples), bool)
    if signal.invalidation_bits is None:
        return np.zeros(len(signal.samples), bool)
    return np.asarray(signal.invalidation_bits, bool)
