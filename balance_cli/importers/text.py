"""Text files of columns: CSV and other separators, decimal comma, exports of Excel and of acquisition programs."""

from __future__ import annotations

import codecs
import functools
import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from balance_cli.importers.base import (
    SNIFFED_BYTES,
    Array,
    ChannelGroup,
    ForeignChannel,
    ForeignFile,
    TextLayout,
    damaged,
)
from balance_cli.importers.text_layout import MISSING_WORDS, Columns, find_columns, split_cells
from balance_cli.importers.time_columns import filled_rows, parts_by_time
from balance_cli.io.errors import UserError
from balance_cli.io.text_cells import find_encoding, is_remark

NAME = "text"
INDEXED_ROWS = 8192
"""Rows between the noted positions in the file: a block is found without reading what is before it."""
SCANNED_BYTES = 2**24
TEXT_CONTROLS = bytes(range(9)) + bytes(range(14, 27)) + b"\x7f"
"""Bytes that no text has, but for the zeros of UTF-16."""


def sniff(path: Path, head: bytes) -> bool:
    """Whether it is text."""
    if find_encoding(head, is_cut=True).startswith("utf-16"):
        return True
    return not any(byte in TEXT_CONTROLS for byte in head[:4096])


def open_file(path: Path, layout: TextLayout) -> ForeignFile:
    """Find the layout and the positions of the rows."""
    with path.open("rb") as file:
        head = file.read(SNIFFED_BYTES)
    is_whole = path.stat().st_size <= len(head)
    encoding = layout.encoding or find_encoding(head, is_cut=not is_whole)
    text = _decode(head, encoding)
    columns = find_columns(text, is_whole, encoding, layout)
    rows, notes = _index_rows(path, columns)
    scalars = {} if columns.stated_rate is None else {"sample_rate": columns.stated_rate}
    dense = [k for k in (*columns.numeric, *columns.clock) if k not in columns.sparse]
    parts = parts_by_time(dense, columns.times)
    groups = [_group(path, columns, rows, part, columns.times) for part in parts if part]
    for place in dict.fromkeys(columns.sparse.values()):
        together = [k for k, own in columns.sparse.items() if own == place]
        groups.append(_sparse_group(_group(path, columns, rows, together), *place))
    texts: dict[str, Callable[[], tuple[str, ...]]] = {
        name: functools.partial(_read_labels, rows, columns, k)
        for k, name in enumerate(columns.names)
        if name and k not in (*columns.numeric, *columns.clock)
    }
    return ForeignFile(path, NAME, tuple(groups), tuple(notes), scalars=scalars, labels=texts)


def _read_labels(rows: _Rows, columns: Columns, column: int) -> tuple[str, ...]:
    """The cells of a column of text; static tables, which have such columns, fit in memory."""
    encoding = "utf-8" if columns.encoding.startswith("utf-16") else columns.encoding
    with rows.open() as file:
        file.seek(int(rows.offsets[0]))
        lines = file.read(rows.end - int(rows.offsets[0])).decode(encoding, "replace").splitlines()
    cells = (split_cells(line, columns.separator) for line in lines[: rows.count])
    return tuple(row[column] if column < len(row) else "" for row in cells)


def _group(path: Path, columns: Columns, rows: _Rows, used: Sequence[int], times: Sequence[int] = ()) -> ChannelGroup:
    channels = tuple(ForeignChannel(columns.names[k], "s" if k in columns.clock else columns.units[k]) for k in used)
    group = ChannelGroup(channels, rows.count, _Table(path, columns, rows, tuple(used)).read)
    own = next((place for place, k in enumerate(used) if k in times), None)
    return group if own is None else replace(group, time=own, samples=filled_rows(group, own))


def _sparse_group(group: ChannelGroup, first: int, stride: int) -> ChannelGroup:
    """The group with the rows that have values: every `stride`-th from row `first` on."""

    def read(columns: Sequence[int], start: int, stop: int) -> Array:
        return group.read(columns, first + start * stride, first + (stop - 1) * stride + 1)[::stride]

    samples = (group.samples - first + stride - 1) // stride
    return replace(group, samples=samples, read=read, first_row=first, stride=stride)


def _decode(head: bytes, encoding: str) -> str:
    try:
        return codecs.getincrementaldecoder(encoding)("replace").decode(head)
    except LookupError as error:
        raise UserError(f"unknown encoding `{encoding}`", remedy="Write utf-8, utf-16, latin-1 or cp1252") from error


@dataclass(frozen=True)
class _Rows:
    """Positions (bytes) of every INDEXED_ROWS-th row of data in a binary stream of single-byte line ends."""

    open: Callable[[], IO[bytes]]
    offsets: NDArray[np.int64]
    end: int
    count: int


def _index_rows(path: Path, columns: Columns) -> tuple[_Rows, list[str]]:
    """Find the rows; a last row that broke off is left out, with a note."""
    open_stream: Callable[[], IO[bytes]] = lambda: path.open("rb")  # noqa: E731
    if columns.encoding.startswith("utf-16"):
        open_stream = functools.partial(io.BytesIO, _as_utf8(path, columns.encoding))
    with open_stream() as file:
        for _ in range(columns.first_row):
            file.readline()
        first = file.tell()
        end = _end_of_text(file)
        ends = _line_ends(file, first, end)
        starts = np.concatenate([[first], ends + 1])
        starts = starts[starts < end]
        if not starts.size:
            remedy = "Save it with a line for each sample, which ends with LF or CR LF"
            raise UserError("has no rows of numbers behind its head", remedy=remedy)
        notes = []
        while is_remark(last := _read_text(file, int(starts[-1]), end)):
            notes.append(f"row {columns.first_row + len(starts)} is a remark and was left out")
            end, starts = int(starts[-1]), starts[:-1]
        file.seek(end)
        if len(split_cells(last, columns.separator)) < len(columns.names) and file.read(1) == b"":
            notes.append(f"row {columns.first_row + len(starts)} broke off and was left out")
            end, starts = int(starts[-1]), starts[:-1]
    return _Rows(open_stream, starts[::INDEXED_ROWS], end, len(starts)), notes


def _read_text(file: IO[bytes], start: int, end: int) -> str:
    file.seek(start)
    return file.read(end - start).decode("latin-1")


def _as_utf8(path: Path, encoding: str) -> bytes:
    """The text of a file in UTF-16; such are exports of Excel, which has at most a million rows."""
    return path.read_bytes().decode(encoding, "replace").encode("utf-8")


def _end_of_text(file: IO[bytes]) -> int:
    """Position after the last byte that is not white space."""
    end = file.seek(0, io.SEEK_END)
    while end > 0:
        size = min(4096, end)
        file.seek(end - size)
        kept = len(file.read(size).rstrip(b"\r\n \t\0\x1a,;"))
        if kept:
            file.seek(end - size)
            tail = file.read(size)[kept:]
            line_end = [position for position in (tail.find(b"\r"), tail.find(b"\n")) if position >= 0]
            return end - size + kept + (min(line_end) if line_end else len(tail))
        end -= size
    return 0


def _line_ends(file: IO[bytes], first: int, end: int) -> NDArray[np.int64]:
    """Positions of the line ends from `first` to `end`."""
    file.seek(first)
    found, position = [], first
    while position < end:
        piece = np.frombuffer(file.read(min(SCANNED_BYTES, end - position)), np.uint8)
        found.append(np.flatnonzero(piece == ord("\n")) + position)
        position += len(piece)
    return np.concatenate(found) if found else np.empty(0, np.int64)


@dataclass(frozen=True)
class _Table:
    """The rows of data, parsed block by block."""

    path: Path
    columns: Columns
    rows: _Rows
    used: tuple[int, ...]

    def read(self, columns: Sequence[int], start: int, stop: int) -> Array:
        """Samples start to stop of some of the channels."""
        first, last = start // INDEXED_ROWS, -(-stop // INDEXED_ROWS)
        offset = int(self.rows.offsets[first])
        end = int(self.rows.offsets[last]) if last < len(self.rows.offsets) else self.rows.end
        with self.rows.open() as file:
            file.seek(offset)
            text = file.read(end - offset)
        row = first * INDEXED_ROWS
        wanted = [self.used[k] for k in columns]
        values = self._parse(text, wanted, row, min(last * INDEXED_ROWS, self.rows.count) - row)
        return values[start - row : stop - row]

    def _parse(self, text: bytes, wanted: Sequence[int], row: int, count: int, has_blanks: bool = True) -> Array:
        import pandas as pd

        clock = [k for k in wanted if k in self.columns.clock]
        numeric = [k for k in wanted if k not in clock]
        options: dict[str, Any] = {"dtype": dict.fromkeys(numeric, np.float64) | dict.fromkeys(clock, str)}
        options |= {"sep": r"\s+"} if self.columns.separator == " " else {"sep": self.columns.separator}
        try:
            table = pd.read_csv(
                io.BytesIO(text),
                header=None,
                names=range(len(self.columns.names)),
                usecols=sorted(set(wanted)),
                decimal=self.columns.decimal,
                na_values=[*MISSING_WORDS, *(word.upper() for word in MISSING_WORDS)],
                index_col=False,
                skip_blank_lines=False,
                encoding="latin-1",
                engine="c",
                **options,
            )
        except (ValueError, pd.errors.ParserError) as error:
            if has_blanks and (plain := _without_blanks(text, self.columns.separator)) != text:
                return self._parse(plain, wanted, row, count, has_blanks=False)
            raise self._bad_row(text, numeric, row, error) from error
        if self._has_extra_cells(text, count):
            raise self._bad_row(text, (), row, "rows of different lengths")
        if len(table) != count:
            raise damaged(f"{len(table)} rows from row {self._file_row(row)} on, where {count} were expected")
        return np.column_stack([self._seconds(table[k]) if k in clock else table[k].to_numpy() for k in wanted])

    def _seconds(self, texts: Any, is_american: bool = False) -> Array:
        """Clock times as seconds from the midnight before, or from 1970 where they have dates.

        Hours of half days are American, so that the month comes first.
        """
        import pandas as pd

        plain = texts.str.replace(",", ".", regex=False)
        if plain.str.contains("[AaPp][Mm]$").all():
            clock = plain.str[:-2].str.strip()
            half_days = plain.str[-2:].str.lower().eq("pm").astype(int) - clock.str.contains(r"(?:^|[ T])12:").astype(
                int
            )
            return np.asarray(self._seconds(clock, is_american=True) + 43200.0 * half_days)
        if plain.str.contains(r"^\d{1,2}:").all():
            return np.asarray(
                pd.to_timedelta(plain.where(plain.str.count(":") == 2, plain + ":00")) / pd.Timedelta("1s")
            )
        day_first = not (str(plain.iloc[0])[:4].isdigit() or is_american)
        times = pd.to_datetime(plain, dayfirst=day_first, utc=True)
        return np.asarray((times - pd.Timestamp(0, tz="UTC")) / pd.Timedelta("1s"))

    def _has_extra_cells(self, text: bytes, count: int) -> bool:
        """Whether a row has more cells than the first one; pandas drops them."""
        separator, width = self.columns.separator, len(self.columns.names)
        if separator == " " or text.count(separator.encode("latin-1")) == count * (width - 1) or b'"' in text:
            return False
        lines = text.decode("latin-1").splitlines()
        return any(line.count(separator) >= width and any(split_cells(line, separator)[width:]) for line in lines)

    def _file_row(self, row: int) -> int:
        return self.columns.first_row + row + 1

    def _bad_row(self, text: bytes, numeric: Sequence[int], row: int, error: object) -> UserError:
        """The error that names the first row with a wrong number of cells, or a cell that is no number."""
        width = len(self.columns.names)
        for k, line in enumerate(text.decode("latin-1").splitlines()):
            cells = split_cells(line, self.columns.separator)
            place = f"row {self._file_row(row + k)}"
            if len(cells) > width and any(cells[width:]):
                fault = f"{len(cells)} cells, where the first row of data has {width}"
                return UserError(fault, place=place, remedy="Correct this row, or state `separator` and `decimal`")
            for column in numeric:
                cell = cells[column] if column < len(cells) else ""
                if cell.lower() not in MISSING_WORDS and not _is_number(cell.replace(self.columns.decimal, ".")):
                    where = f"{place}, column `{self.columns.names[column]}`"
                    return UserError(f"`{cell[:40]}` is not a number", place=where, remedy="Correct or remove this row")
        return damaged(error)


def _without_blanks(text: bytes, separator: str) -> bytes:
    """The text without blanks beside separators: pandas takes `- ` and ` ` for words."""
    sign = re.escape(separator.encode("latin-1"))
    blanks = rb"(?:^|(?<=[\n" + sign + rb"])) +| +(?=[\r\n" + sign + rb"]|$)"
    return re.sub(blanks, b"", text) if separator != " " else text


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
