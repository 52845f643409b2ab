"""Remarks between the rows of a text file, which loggers and people write there: left out, and counted in a note."""

from __future__ import annotations

import functools
import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from balance_cli.importers.text_blocks import FEWEST_BLOCK_ROWS, split_cells
from balance_cli.importers.text_clock import seconds_of_clock
from balance_cli.importers.text_layout import Columns
from balance_cli.importers.time_columns import is_time_column
from balance_cli.io.errors import UserError
from balance_cli.io.text_format import REMARKS
from balance_cli.io.text_numbers import is_missing

READ_BYTES = 2**22
"""Bytes searched at a time for lines that may be remarks: hardly any file has some."""
MOST_NAMED = 3
"""Remarks that a note quotes."""
MOST_LETTERS = 40
"""Letters of a remark that a message quotes."""
REMARK_LINE = re.compile(rb"\n[ \t]*(?:#|%|//|[A-Za-z])")
"""Where a line begins with the sign of a remark or a letter."""
TEXT_ROW = re.compile(rb"^[ \t]*[A-Za-z][^,;\t]*\r?$")
"""A line of one cell that begins with a letter, such as `Block 2`."""
CELLS = re.compile(rb"[,;\t ]+")
"""What stands between cells, whatever the separator is."""
FEWEST_ROWS = 2
"""Rows of numbers above a remark from which these are data, where it has no names: a head may have one of settings."""
DATA_ROW = re.compile(rb'^[\s"+\-.,;]*\d')
"""A line that begins with a number, after empty cells or not."""


@dataclass(frozen=True)
class Remarks:
    """The rows of a file (from 0) that are remarks between rows of data, with their text; the bytes without them.

    `beside`: the rows of data above and below each.
    """

    rows: tuple[int, ...] = ()
    texts: tuple[str, ...] = ()
    beside: tuple[tuple[str, str], ...] = ()
    cleaned: bytes = b""

    def open(self, path: Path) -> Callable[[], IO[bytes]]:
        """How the file is opened without them."""
        return functools.partial(io.BytesIO, self.cleaned) if self.rows else lambda: path.open("rb")

    def row_of_file(self, row: int) -> int:
        """Row of the file (from 0) of a row of what is left."""
        for place in self.rows:
            row += place <= row
        return row

    def note(self) -> str:
        """What was left out, in words; empty where nothing was."""
        if not self.rows:
            return ""
        pairs = list(zip(self.rows, self.texts, strict=True))[:MOST_NAMED]
        shown = ", ".join(f"row {row + 1} `{text[:MOST_LETTERS]}`" for row, text in pairs)
        more = f" and {len(self.rows) - MOST_NAMED} more" if len(self.rows) > MOST_NAMED else ""
        number = "a remark" if len(self.rows) == 1 else f"{len(self.rows)} remarks"
        return f"{number} between the rows of data left out: {shown}{more}"

    def require_going_on(self, columns: Columns) -> None:
        """Raise UserError where no times show that the rows below a remark are those after the rows above it."""
        for row, text, pair in zip(self.rows, self.texts, self.beside, strict=True):
            if not _goes_on([split_cells(line, columns.separator) for line in pair], columns):
                fault = f"the remark `{text[:MOST_LETTERS]}` stands within the data"
                remedy = "Remove this row if the samples go on without a gap, or save what is below as another file"
                raise UserError(fault, place=f"row {row + 1}", remedy=remedy)


def _goes_on(pair: Sequence[Sequence[str]], columns: Columns) -> bool:
    """Whether the first column of times is later in the second of two rows."""
    numeric = [k for k in columns.numeric if is_time_column(columns.names[k], columns.units[k])]
    place = min((*columns.clock, *numeric), default=None)
    if place is None or any(len(cells) <= place for cells in pair):
        return False
    cells = [row[place] for row in pair]
    if place in columns.clock:
        import pandas as pd

        before, after = seconds_of_clock(pd.Series(cells), columns.names[place])
        return bool(after > before)
    try:
        before, after = (float(cell.replace(columns.decimal, ".")) for cell in cells)
    except ValueError:
        return False
    return after > before


def find_remarks(path: Path, text: bytes | None, encoding: str) -> Remarks:
    """Find the remarks between rows of data; `text` is that of a file which is held as a whole, in UTF-8."""
    if text is None and not _may_have_remarks(path):
        return Remarks()
    whole = path.read_bytes() if text is None else text
    lines = whole.split(b"\n")
    rows = _remark_rows(lines)
    if not rows:
        return Remarks()
    removed = set(rows)
    cleaned = b"\n".join(line for row, line in enumerate(lines) if row not in removed)
    code = "utf-8" if encoding.startswith("utf-16") else encoding
    texts = [lines[row].decode(code, "replace").strip() for row in rows]
    data = [row for row in range(rows[0] - 1, len(lines)) if row not in removed]
    at = np.searchsorted(data, rows)
    beside = [tuple(lines[data[k]].decode(code, "replace") for k in (place - 1, place)) for place in at.tolist()]
    return Remarks(tuple(rows), tuple(texts), tuple((above, below) for above, below in beside), cleaned)


def _may_have_remarks(path: Path) -> bool:
    """Whether a line that begins with a letter or the sign of a remark stands below one that begins with a number."""
    with path.open("rb") as file:
        last, numbers = b"\n", False
        while block := file.read(READ_BYTES):
            block = last + block
            first = re.search(rb"\n[+\-.]?\d", block) if not numbers else None
            numbers = numbers or first is not None
            if numbers and REMARK_LINE.search(block, first.start() if first else 0):
                return True
            last = block[-2:]
    return False


def _remark_rows(lines: Sequence[bytes]) -> list[int]:
    """Rows of remarks that have rows of data directly above and below, but for further remarks."""
    found: list[int] = []
    waiting: list[int] = []
    data, above = 0, b""
    for row, line in enumerate(lines):
        if DATA_ROW.match(line):
            found += waiting
            waiting, data, above = [], data + 1, line
        elif _is_remark(line, above, data) or (data >= FEWEST_BLOCK_ROWS and _is_text(line, lines[row - 1])):
            waiting.append(row)
        else:
            waiting, data = [], 0
    return found


def _is_remark(line: bytes, above: bytes, data: int) -> bool:
    """Whether a line has the sign of a remark, below some rows of `data`, the last of which is `above`.

    Below few rows it may have the names of what follows, which are as many as the cells of a row.
    """
    text = line.lstrip()
    if data < FEWEST_ROWS or not text.startswith(tuple(sign.encode() for sign in REMARKS)):
        return False
    width = len(CELLS.split(above.strip()))
    return data >= FEWEST_BLOCK_ROWS or (width > 1 and len(CELLS.split(text.lstrip(b"#%/ ").rstrip())) != width)


def _is_text(line: bytes, above: bytes) -> bool:
    """Whether a line is one cell of text, and no missing value, below a line of several cells or another text."""
    is_row = len(CELLS.split(above.strip())) > 1 or TEXT_ROW.match(above) is not None
    return bool(TEXT_ROW.match(line)) and is_row and not is_missing(line.decode("latin-1").strip())
