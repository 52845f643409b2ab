"""MDF files of ASAM, version 4 (and 3), read channel by channel by asammdf."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from balance_cli.importers.base import (
    Array,
    ChannelGroup,
    ForeignChannel,
    ForeignFile,
    TextLayout,
    damaged,
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
SIGNATURES = (b"MDF     ", b"UnFinMF ")


def sniff(path: Path, head: bytes) -> bool:
    """Whether it begins with the identification of an MDF file."""
    return head[:8] in SIGNATURES


def open_file(path: Path, layout: TextLayout) -> ForeignFile:
    """List the channels of every channel group; the rate is that of its master channel."""
    require_package("asammdf", "MDF4", "asammdf")
    with path.open("rb") as stream:
        if stream.read(IDENTIFICATION + 4)[IDENTIFICATION:][:2] not in (b"##", b"HD"):
            raise damaged("no header block behind the identification")
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

    with errors_as_damage(), MDF(path) as file:
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
        stamps = np.asarray(file.get_master(index), float)
        if len(stamps) != samples:
            raise damaged(f"{len(stamps)} times for {samples} samples")
        try:
            axis = read_time_axis(lambda _, first, last: stamps[first:last, None], samples)
            rate, start = axis.rate, axis.start
        except UserError as error:
            unusable = f"sampled at uneven times ({error.fault})"
    channels = tuple(ForeignChannel(channel.name, _unit(channel)) for _, channel in names)
    return _Listed(index, channels, tuple(k for k, _ in names), samples, rate, start, unusable)


def _group(path: Path, listed: _Listed) -> ChannelGroup:
    load = cache(lambda position: _map_channel(path, listed.index, position))

    def read(columns: Sequence[int], first: int, last: int) -> Array:
        return np.column_stack([np.asarray(load(listed.positions[k])[first:last], np.float64) for k in columns])

    return ChannelGroup(listed.channels, listed.samples, read, listed.rate, listed.start, listed.unusable)


def _unit(channel: Any) -> str:
    conversion = getattr(channel, "conversion", None)
    return str(getattr(channel, "unit", "") or getattr(conversion, "unit", "") or "")


def _map_channel(path: Path, index: int, position: int) -> Any:
    """A whole channel, mapped from a temporary file: asammdf reads part of a channel no faster than all of it."""
    values = _load_channel(path, index, position)
    with tempfile.TemporaryFile() as scratch:
        mapped = np.memmap(scratch, values.dtype, "w+", shape=values.shape)
        mapped[:] = values
    return mapped


@read_in_child
def _load_channel(path: Path, index: int, position: int) -> Any:
    from asammdf import MDF

    with errors_as_damage(path), MDF(path) as file:
        values = np.asarray(file.get(group=index, index=position, samples_only=True)[0])
    if values.dtype.kind not in "iufb" or values.ndim != 1 or not len(values):
        raise UserError("a channel holds no real numbers", str(path), remedy="Leave it out of the map")
    return values
