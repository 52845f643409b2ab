"""MDF files of ASAM, version 4 (and 3), read channel by channel by asammdf."""

from __future__ import annotations

from collections.abc import Sequence
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
    missing_package,
)
from balance_cli.importers.time_axis import read_time_axis
from balance_cli.io.errors import UserError

NAME = "MDF"
IDENTIFICATION = 64
"""Bytes of the identification block, which the header block follows."""
SIGNATURES = (b"MDF     ", b"UnFinMF ")


def sniff(path: Path, head: bytes) -> bool:
    """Whether it begins with the identification of an MDF file."""
    return head[:8] in SIGNATURES


def open_file(path: Path, layout: TextLayout) -> ForeignFile:
    """List the channels of every channel group; the rate is that of its master channel."""
    try:
        from asammdf import MDF
    except ImportError as error:
        raise missing_package("MDF4", "asammdf") from error
    with path.open("rb") as stream:
        if stream.read(IDENTIFICATION + 4)[IDENTIFICATION:][:2] not in (b"##", b"HD"):
            raise damaged("no header block behind the identification")
    try:
        with MDF(path) as file:
            begin = file.header.start_time
            groups = [group for index in range(len(file.groups)) for group in _groups(path, file, index)]
    except UserError:
        raise
    except Exception as error:  # asammdf raises whatever damaged bytes lead to
        raise damaged(error) from error
    if not groups:
        raise UserError("has no channels with samples", remedy="Give a file with channels")
    return ForeignFile(path, NAME, tuple(groups), recorded=begin.isoformat(timespec="seconds") if begin else None)


def _groups(path: Path, file: Any, index: int) -> list[ChannelGroup]:
    """The numeric channels of a channel group; one whose time steps differ cannot be used."""
    group = file.groups[index]
    master = file.masters_db.get(index)
    samples = int(group.channel_group.cycles_nr)
    names = [(k, channel) for k, channel in enumerate(group.channels) if k != master]
    if samples < 2 or not names:
        return []
    unusable, rate, start = "", None, 0.0
    if master is not None:

        def time(columns: Sequence[int], first: int, last: int) -> Array:
            return np.asarray(file.get_master(index, record_offset=first, record_count=last - first), float)[:, None]

        try:
            axis = read_time_axis(time, samples)
            rate, start = axis.rate, axis.start
        except UserError as error:
            unusable = f"sampled at uneven times ({error.fault})"
    channels = tuple(ForeignChannel(channel.name, _unit(channel)) for _, channel in names)
    positions = [k for k, _ in names]

    def read(columns: Sequence[int], first: int, last: int) -> Array:
        return _read(path, index, [positions[k] for k in columns], first, last)

    return [ChannelGroup(channels, samples, read, rate, start, unusable)]


def _unit(channel: Any) -> str:
    conversion = getattr(channel, "conversion", None)
    return str(getattr(channel, "unit", "") or getattr(conversion, "unit", "") or "")


def _read(path: Path, index: int, positions: Sequence[int], first: int, last: int) -> Array:
    from asammdf import MDF

    try:
        with MDF(path) as file:
            columns = [
                file.get(group=index, index=k, record_offset=first, record_count=last - first, samples_only=True)[0]
                for k in positions
            ]
    except Exception as error:
        raise damaged(error).with_location(file=str(path)) from error
    for values in columns:
        if np.asarray(values).dtype.kind not in "iufb" or np.ndim(values) != 1:
            raise UserError("a channel holds no real numbers", str(path), remedy="Leave it out of the map")
    return np.column_stack([np.asarray(values, np.float64) for values in columns])
