"""Where the rows of a long text file are, so that a block is found without reading what is before it."""

from __future__ import annotations

import functools
import io
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from balance_cli.importers.text_blocks import split_cells
from balance_cli.importers.text_end import Cut, cut_number
from balance_cli.importers.text_layout import Columns
from balance_cli.importers.text_remarks import Remarks
from balance_cli.io.errors import UserError
from balance_cli.io.text_format import is_remark

INDEXED_ROWS = 8192
"""Rows between the noted positions in the file."""
SCANNED_BYTES = 2**22
"""Bytes searched for line ends at a time: the positions found take up to four times as much."""
TAIL_BYTES = 4096
"""Bytes read at a time from the end of a file backward: a row is shorter."""


@dataclass(frozen=True)
class Rows:
    """Positions (bytes) of every INDEXED_ROWS-th row of data in a binary stream of single-byte line ends."""

    open: Callable[[], IO[bytes]]
    offsets: NDArray[np.int64]
    end: int
    count: int
    remarks: Remarks = field(default_factory=Remarks)


def index_rows(path: Path, columns: Columns, remarks: Remarks, held: bytes | None) -> tuple[Rows, list[str]]:
    """Find the rows; remarks between and behind them and a last row that broke off are left out, with a note.

    `held`: what a file that is held as a whole has, in place of its bytes.
    """
    open_stream: Callable[[], IO[bytes]] = remarks.open(path)
    if held is not None and not remarks.rows:
        open_stream = functools.partial(io.BytesIO, held)
    with open_stream() as file:
        for _ in range(columns.first_row):
            file.readline()
        first, end, left_out = file.tell(), _end_of_text(file), []
        if end <= first:
            remedy = "Save it with a line for each sample, which ends with LF or CR LF"
            raise UserError("has no rows of numbers behind its head", remedy=remedy)
        while end > first and is_remark(_last_line(file, first, end)):
            left_out.append("is a remark")
            end = _start_of_line(file, first, end)
        end_fault = _broken_end(file, first, end, columns)
        if end_fault in ("broke off", Cut.YES.value):
            left_out.append(end_fault)
            end = _start_of_line(file, first, end)
        offsets, count = _index_lines(file, first, end)
    last_row = remarks.row_of_file(columns.first_row + count + len(left_out) - 1) + 1
    notes = [*filter(None, [remarks.note()])]
    notes += [f"row {last_row - k} {why} and was left out" for k, why in enumerate(left_out)]
    if end_fault == Cut.MAYBE.value:
        notes.append(f"row {remarks.row_of_file(columns.first_row + count - 1) + 1} {end_fault}")
    return Rows(open_stream, offsets, end, count, remarks), notes


def _broken_end(file: IO[bytes], first: int, end: int, columns: Columns) -> str:
    """What is wrong with the last row of data, of a file that ends without a line end; empty where nothing is."""
    file.seek(end)
    if file.read(1):
        return ""
    begin = max(end - TAIL_BYTES, first)
    file.seek(begin)
    lines = file.read(end - begin).decode("latin-1").splitlines()[begin > first :]
    rows = [split_cells(line, columns.separator) for line in lines]
    if not rows or len(rows[-1]) < len(columns.names):
        return "broke off"
    width = len(rows[-1])
    return cut_number(rows[-1][-1], [row[-1] for row in rows[:-1] if len(row) == width]).value


def as_utf8(path: Path, encoding: str) -> bytes:
    """Return the text of a file in UTF-16; such are exports of Excel, which has at most a million rows."""
    return path.read_bytes().decode(encoding, "replace").encode("utf-8")


def _end_of_text(file: IO[bytes]) -> int:
    """Position after the last byte that is not white space."""
    end = file.seek(0, io.SEEK_END)
    while end > 0:
        size = min(TAIL_BYTES, end)
        file.seek(end - size)
        text_length = len(file.read(size).rstrip(b"\r\n \t\0\x1a,;"))
        if text_length:
            file.seek(end - size)
            tail = file.read(size)[text_length:]
            line_end = [position for position in (tail.find(b"\r"), tail.find(b"\n")) if position >= 0]
            return end - size + text_length + (min(line_end) if line_end else len(tail))
        end -= size
    return 0


def _start_of_line(file: IO[bytes], first: int, end: int) -> int:
    """Where the line begins that ends at `end`, with or without its line end."""
    begin = end - 1
    while begin > first:
        size = min(TAIL_BYTES, begin - first)
        file.seek(begin - size)
        place = file.read(size).rfind(b"\n")
        if place >= 0:
            return begin - size + place + 1
        begin -= size
    return first


def _last_line(file: IO[bytes], first: int, end: int) -> str:
    start = _start_of_line(file, first, end)
    file.seek(start)
    return file.read(end - start).decode("latin-1")


def _index_lines(file: IO[bytes], first: int, end: int) -> tuple[NDArray[np.int64], int]:
    """Positions of every INDEXED_ROWS-th line from `first` to `end`, and the number of lines."""
    file.seek(first)
    offsets, position, count = [np.array([first])], first, 1
    while position < end:
        piece = np.frombuffer(file.read(min(SCANNED_BYTES, end - position)), np.uint8)
        starts = np.flatnonzero(piece == ord("\n")) + (position + 1)
        starts = starts[starts < end]
        offsets.append(starts[-count % INDEXED_ROWS :: INDEXED_ROWS])
        count, position = count + len(starts), position + len(piece)
    return np.concatenate(offsets) if end > first else np.empty(0, np.int64), count if end > first else 0
