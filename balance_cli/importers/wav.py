"""WAV files: integers become fractions of full scale.

Source: Microsoft and IBM, "Multimedia Programming Interface and Data Specifications 1.0", 1991; RF64: EBU Tech 3306.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from balance_cli.importers.base import (
    Array,
    ChannelGroup,
    ForeignChannel,
    ForeignFile,
    TextLayout,
    damage_error,
    select_columns,
)
from balance_cli.io.errors import UserError

NAME = "WAV"
INTEGER, FLOAT, EXTENSIBLE = 1, 3, 0xFFFE
UNKNOWN_SIZE = 0xFFFFFFFF
"""Size of a data chunk that was never completed, or of one above 4 GB (RF64)."""
LEAST_FORMAT_SIZE = 16
"""Bytes of a format chunk without extension."""


def sniff(path: Path, head: bytes) -> bool:
    """Whether it is a RIFF, RIFX or RF64 file of type WAVE."""
    return head[:4] in (b"RIFF", b"RIFX", b"RF64") and head[8:12] == b"WAVE"


def open_file(path: Path, layout: TextLayout) -> ForeignFile:
    """Find format and samples."""
    order, form, offset, size, stated = _chunks(path)
    code, count, rate, _, frame, bits = struct.unpack(f"{order}HHIIHH", form[:16])
    if code == EXTENSIBLE and len(form) >= 26:
        code = struct.unpack(f"{order}H", form[24:26])[0]
    known = (code == INTEGER and bits in (8, 16, 24, 32)) or (code == FLOAT and bits in (32, 64))
    if not known or not count or frame != count * bits // 8 or not rate:
        fault = f"holds samples of {bits} bits in coding {code}"
        raise UserError(fault, remedy="Export it as PCM of 8 to 32 bits or as floating point")
    samples = size // frame
    if samples < 2:
        raise damage_error("no samples")

    def read(columns: Sequence[int], start: int, stop: int) -> Array:
        raw = np.fromfile(path, np.uint8, (stop - start) * frame, offset=offset + start * frame)
        if len(raw) < (stop - start) * frame:
            raise damage_error("samples end early").with_location(file=str(path))
        return select_columns(_values(raw, order, code, bits).reshape(-1, count), columns)

    channels = tuple(ForeignChannel(f"channel {k + 1}", "1") for k in range(count))
    notes = [] if code == FLOAT else ["integers are read as fractions of full scale"]
    if stated // frame > samples:
        notes.append(f"the file ends early, after {samples} of {stated // frame} samples")
    return ForeignFile(path, NAME, (ChannelGroup(channels, samples, read, float(rate)),), tuple(notes))


def _chunks(path: Path) -> tuple[str, bytes, int, int, int]:
    """Byte order, format chunk, first byte of the samples, their bytes in the file, and those that the file states."""
    length, form, wide = path.stat().st_size, b"", 0
    with path.open("rb") as file:
        order = ">" if file.read(12)[:4] == b"RIFX" else "<"
        while len(head := file.read(8)) == 8:
            name, size = head[:4], struct.unpack(f"{order}I", head[4:])[0]
            if name == b"data":
                if len(form) < LEAST_FORMAT_SIZE:
                    break
                available = length - file.tell()
                size = wide if wide and size == UNKNOWN_SIZE else size
                stated = available if size == UNKNOWN_SIZE else size
                return order, form, file.tell(), min(size, available), stated
            if name == b"fmt ":
                form = file.read(size)
            elif name == b"ds64":
                wide = int.from_bytes(file.read(size)[8:16], "little")
            else:
                file.seek(size, 1)
            file.seek(size % 2, 1)
    raise damage_error("no format and data chunks")


def _values(raw: NDArray[np.uint8], order: str, code: int, bits: int) -> Array:
    if code == FLOAT:
        return np.asarray(raw.view(f"{order}f{bits // 8}"), np.float64)
    if bits == 8:
        return (raw.astype(np.float64) - 128.0) / 128.0
    if bits == 24:
        parts = raw.reshape(-1, 3) if order == "<" else raw.reshape(-1, 3)[:, ::-1]
        wide = np.zeros((len(parts), 4), np.uint8)
        wide[:, 1:] = parts
        return wide.view("<i4")[:, 0] / 2.0**31
    return np.asarray(raw.view(f"{order}i{bits // 8}") / 2.0 ** (bits - 1))
