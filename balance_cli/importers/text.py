"""Text files of columns: CSV and other separators, decimal comma, exports of Excel and of acquisition programs."""

from __future__ import annotations

import codecs
import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from balance_cli.importers.base import SNIFFED_BYTES, Array, ChannelGroup, ForeignChannel, ForeignFile, TextLayout
from balance_cli.importers.labview_segments import MAGIC, joined_segments
from balance_cli.importers.text_blocks import split_cells
from balance_cli.importers.text_layout import Columns, find_columns
from balance_cli.importers.text_remarks import find_remarks
from balance_cli.importers.text_rows import Rows, as_utf8, index_rows
from balance_cli.importers.text_table import TextTable
from balance_cli.importers.time_columns import filled_rows, parts_by_time
from balance_cli.io.errors import UserError
from balance_cli.io.text_format import find_encoding

NAME = "text"
RATE = "sample_rate"
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
    size, content, joined_note = path.stat().st_size, None, []
    if head.startswith(MAGIC) and layout.first_row is None and (joined := joined_segments(path.read_bytes())):
        content, count = joined
        head, size = content[:SNIFFED_BYTES], len(content)
        joined_note = [f"{count} segments continue each other, and are one record"]
    is_whole = size <= len(head)
    encoding = layout.encoding or find_encoding(head, is_cut=not is_whole)
    text = _decode(head, encoding)
    held = as_utf8(path, encoding) if encoding.startswith("utf-16") else content
    remarks = find_remarks(path, held, encoding)
    if remarks.rows:
        text = _decode(remarks.cleaned[:SNIFFED_BYTES], "utf-8" if encoding.startswith("utf-16") else encoding)
    columns = find_columns(text, is_whole, encoding, layout)
    remarks.require_going_on(columns)
    rows, notes = index_rows(path, columns, remarks, held)
    if columns.left_out:
        notes.append(f"the rows have no cells for the last names of the head: {', '.join(columns.left_out)}")
    # Several are those of different channels.
    several = len(columns.stated_rates) > 1
    scalars = {f"{k}.{RATE}" if several else RATE: rate for k, rate in enumerate(columns.stated_rates)}
    dense = [k for k in sorted((*columns.numeric, *columns.clock)) if k not in columns.sparse]
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
    return ForeignFile(path, NAME, tuple(groups), (*joined_note, *notes), scalars=scalars, labels=texts)


def _read_labels(rows: Rows, columns: Columns, column: int) -> tuple[str, ...]:
    """The cells of a column of text; static tables, which have such columns, fit in memory."""
    encoding = "utf-8" if columns.encoding.startswith("utf-16") else columns.encoding
    with rows.open() as file:
        file.seek(int(rows.offsets[0]))
        lines = file.read(rows.end - int(rows.offsets[0])).decode(encoding, "replace").splitlines()
    cells = (split_cells(line, columns.separator) for line in lines[: rows.count])
    return tuple(row[column] if column < len(row) else "" for row in cells)


def _group(path: Path, columns: Columns, rows: Rows, used: Sequence[int], times: Sequence[int] = ()) -> ChannelGroup:
    channels = tuple(ForeignChannel(columns.names[k], "s" if k in columns.clock else columns.units[k]) for k in used)
    group = ChannelGroup(channels, rows.count, TextTable(path, columns, rows, tuple(used)).read)
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
