"""The rows of a text file as numbers, parsed block by block."""

from __future__ import annotations

import io
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from balance_cli.importers.base import Array, damage_error
from balance_cli.importers.text_blocks import split_cells, with_cells_apart
from balance_cli.importers.text_clock import seconds_of_clock
from balance_cli.importers.text_layout import Columns
from balance_cli.importers.text_rows import INDEXED_ROWS, Rows
from balance_cli.io.errors import UserError
from balance_cli.io.text_numbers import (
    MISSING_WORDS,
    fillers_as_missing,
    is_missing,
    without_blanks,
    without_fortran_exponents,
    without_group_signs,
)

NEWLINE = b"\n"
LINE_ENDS = (b"\n", b"\r\n")
EMPTY_LINES = tuple(NEWLINE + end for end in LINE_ENDS)


@dataclass(frozen=True)
class TextTable:
    """The rows of data of some columns."""

    path: Path
    columns: Columns
    rows: Rows
    used: tuple[int, ...]

    def read(self, columns: Sequence[int], start: int, stop: int) -> Array:
        """Samples start to stop of some of the channels."""
        first, last = start // INDEXED_ROWS, -(-stop // INDEXED_ROWS)
        wanted = [self.used[k] for k in columns]
        values = np.empty((stop - start, len(wanted)))
        with self.rows.open() as file:
            for place in range(first, last):
                row = place * INDEXED_ROWS
                offset = int(self.rows.offsets[place])
                is_last = place + 1 >= len(self.rows.offsets)
                file.seek(offset)
                text = file.read((self.rows.end if is_last else int(self.rows.offsets[place + 1])) - offset)
                part = self._parse(text, wanted, row, min(INDEXED_ROWS, self.rows.count - row))
                begin, end = max(start, row), min(stop, row + len(part))
                values[begin - start : end - start] = part[begin - row : end - row]
        return fillers_as_missing(values)

    def _parse(self, text: bytes, wanted: Sequence[int], row: int, count: int) -> Array:
        import pandas as pd

        layout = self.columns
        text = with_cells_apart(text, layout.separator)
        if layout.group_sign:
            encoding = "utf-8" if layout.encoding.startswith("utf-16") else layout.encoding
            text = without_group_signs(text, layout.group_sign, layout.decimal, layout.separator, encoding)
        clock = [k for k in wanted if k in layout.clock]
        fractions = [layout.fractions[k][0] for k in clock if k in layout.fractions]
        wanted, shown = [*wanted, *fractions], len(wanted)
        numeric = [k for k in wanted if k not in clock]
        types = dict.fromkeys(numeric, np.float64) | dict.fromkeys(clock, str)
        try:
            table = self._table(text, wanted, types)
        except (ValueError, pd.errors.ParserError) as error:
            plain = without_fortran_exponents(without_blanks(text, layout.separator))
            try:
                table = self._table(plain, wanted, types)
            except (ValueError, pd.errors.ParserError):
                raise self._bad_row(text, numeric, row, error) from error
        self._require_even_rows(text, row, count)
        if len(table) != count:
            raise damage_error(f"{len(table)} rows from row {self._file_row(row)} on, where {count} were expected")
        place = f"column `{layout.names[clock[0]]}`" if clock else ""
        return np.column_stack([self._column(table, k, place) for k in wanted[:shown]])

    def _column(self, table: Any, column: int, place: str) -> Any:
        """The numbers of a column, of times in seconds with the parts that a column of their own counts."""
        if column not in self.columns.clock:
            return table[column]
        seconds = seconds_of_clock(table[column], place)
        part, factor = self.columns.fractions.get(column, (column, 0.0))
        return seconds + factor * np.asarray(table[part]) if factor else seconds

    def _table(self, text: bytes, wanted: Sequence[int], types: dict[int, Any]) -> Any:
        """A table of some columns. Raises ValueError, or that of pandas, where a cell is not of its type."""
        import pandas as pd

        return pd.read_csv(
            io.BytesIO(text),
            sep=r"\s+" if self.columns.separator == " " else self.columns.separator,
            header=None,
            names=range(len(self.columns.names)),
            usecols=sorted(set(wanted)),
            dtype=types,
            decimal=self.columns.decimal,
            na_values=[*MISSING_WORDS, *(word.upper() for word in MISSING_WORDS)],
            index_col=False,
            skip_blank_lines=False,
            encoding="latin-1",
            engine="c",
        )

    def _require_even_rows(self, text: bytes, row: int, count: int) -> None:
        """Raise UserError where a row is empty, or has more cells than the first one: pandas drops them.

        A row with fewer cells is no better, since nothing says which is missing; only columns that end above the others
        leave shorter rows, down to the last one.
        """
        separator, width = self.columns.separator, len(self.columns.names)
        empty = 0 if text.startswith(LINE_ENDS) else max(map(text.find, EMPTY_LINES)) + 1
        if empty or text.startswith(LINE_ENDS):
            place = f"row {self._file_row(row + text.count(NEWLINE, 0, empty))}"
            raise UserError("an empty row within the data", place=place, remedy="Remove it, or cut the record there")
        if b'"' in text:
            return
        if separator == " ":
            if len(text.split()) != count * width:
                raise self._uneven_row(text, row, lambda cells: len(cells) != width)
        elif text.count(separator.encode("latin-1")) != count * (width - 1):
            lines = text.decode("latin-1").splitlines()
            if any(line.count(separator) >= width and any(split_cells(line, separator)[width:]) for line in lines):
                raise self._uneven_row(text, row, lambda cells: any(cells[width:]))
            least = max((*self.columns.numeric, *self.columns.clock)) + 1
            is_short = [line.count(separator) + 1 < least for line in lines]
            if not self.columns.sparse and any(before and not after for before, after in itertools.pairwise(is_short)):
                raise self._uneven_row(text, row, lambda cells: len(cells) < least)

    def _uneven_row(self, text: bytes, row: int, is_uneven: Callable[[Sequence[str]], bool]) -> UserError:
        """The error that names the first row with a wrong number of cells."""
        for k, line in enumerate(text.decode("latin-1").splitlines()):
            cells = split_cells(line, self.columns.separator)
            if is_uneven(cells):
                fault = f"{len(cells)} cells, where the first row of data has {len(self.columns.names)}"
                place = f"row {self._file_row(row + k)}"
                return UserError(fault, place=place, remedy="Correct this row, or state `separator` and `decimal`")
        return damage_error("rows of different lengths")

    def _file_row(self, row: int) -> int:
        return self.rows.remarks.row_of_file(self.columns.first_row + row) + 1

    def _bad_row(self, text: bytes, numeric: Sequence[int], row: int, error: object) -> UserError:
        """The error that names the first row with too many cells, or a cell that is no number."""
        width = len(self.columns.names)
        for k, line in enumerate(text.decode("latin-1").splitlines()):
            cells = split_cells(line, self.columns.separator)
            if any(cells[width:]):
                return self._uneven_row(text, row, lambda cells: any(cells[width:]))
            for column in numeric:
                cell = cells[column] if column < len(cells) else ""
                if not is_missing(cell) and not _is_number(cell.replace(self.columns.decimal, ".")):
                    where = f"row {self._file_row(row + k)}, column `{self.columns.names[column]}`"
                    return UserError(f"`{cell[:40]}` is not a number", place=where, remedy="Correct or remove this row")
        return damage_error(error)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
