"""Text tables as laboratories write them: separators, decimal commas, comments, title lines, units in the head.

The separator is a tab, `;`, `|`, a comma or white space, whichever splits the lines into the same number of columns.
Where none does, numbers alone on their lines are a table of one column. Lines that begin with `#`, `%` or `//` are
comments. The head is the line above the first line of numbers; a line of units, or the heading of a block, may stand
between them. Lines above the head are titles. A head that is repeated within the table is left out; so are lines
without numbers, and rows of statistics, which are listed.
"""

from __future__ import annotations

import csv
import hashlib
import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from balance_cli.io.errors import UserError
from balance_cli.io.other_units import is_other_unit
from balance_cli.io.sniff import describe_file, is_hdf5, require_file
from balance_cli.io.table_rows import require_even_rows, separate_rows, unnamed_columns
from balance_cli.io.text_format import SEPARATORS, find_encoding, is_remark, require_plain_text
from balance_cli.io.text_numbers import FILLER_RATIO, fillers_as_missing, is_grouped, is_missing
from balance_cli.io.units import is_unit

Array = NDArray[np.float64]

MAX_BYTES = 100_000_000
"""Size from which a file is refused unread: a million load points of twenty columns have less."""
MIN_NUMBER_SHARE = 0.5
"""Share of the cells of a line of data that are numbers at least: labels of runs and series are fewer."""
MIN_EVEN_SHARE = 0.8
"""Share of the lines with numbers that have as many columns, from which a separator is credible."""
MIN_COLUMN_ROWS = 2
"""Numbers, each alone on its line, that are a table of one column: a single one may stand in any text."""
DECIMAL_COMMA = re.compile(r"^[+-]?\d*,\d+(e[+-]?\d+)?$", re.IGNORECASE)
CLEAR_GROUP_SIGN = re.compile(r"(?<=\d)['\u2019\u00a0\u202f](?=\d{3}(?!\d))")
"""Apostrophes (Switzerland) and no-break spaces between thousands, which can be nothing else."""

Row = tuple[int, tuple[str, ...]]


@dataclass(frozen=True)
class TextTable:
    """A table as text: `header` names the columns, `units` are those of a units row (empty where there is none).

    `rows`: line number in the file and cells of each row; `decimal_comma`: whether numbers have one; `has_groups`:
    whether some have a sign between thousands beside a decimal sign; `digest` is the hex SHA-256 of the file.
    `other_rows`: lines below the head that are no rows of the table; `unnamed`: columns without a name that hold
    something.
    """

    path: Path
    header: tuple[str, ...]
    units: tuple[str, ...]
    rows: tuple[Row, ...]
    decimal_comma: bool
    digest: str
    has_groups: bool = False
    other_rows: tuple[Row, ...] = ()
    unnamed: int = 0

    def error(self, line: int, column: str, fault: str, remedy: str) -> UserError:
        """The error to raise for a fault in one cell, or with line 0 in a whole column."""
        place = ", ".join(part for part in (f"line {line}" if line else "", f"column `{column}`") if part)
        return UserError(fault, str(self.path), place, remedy)

    def texts(self, column: int) -> tuple[str, ...]:
        """The cells (n,) of a column."""
        return tuple(cells[column] for _, cells in self.rows)

    def numbers(
        self, column: int, allow_missing: bool = False, allow_empty: bool = False, ratio: float = FILLER_RATIO
    ) -> Array:
        """The numbers (n,) of a column; raises UserError, with line and column, for a cell that is not a number.

        With `allow_missing` they are NaN where a word (`NA`, `-`) or a number such as -9999, more than `ratio` times
        all others, stands for no value, and with `allow_empty` where the cell is empty.
        """
        name = self.header[column]
        cells = [(line, row[column] or ("nan" if allow_empty else "")) for line, row in self.rows]
        values = np.array([self._number(line, cell, name, allow_missing) for line, cell in cells])
        return fillers_as_missing(values[:, None], ratio)[:, 0] if allow_missing else values

    def _number(self, line: int, cell: str, column: str, allow_missing: bool) -> float:
        if not cell:
            raise self.error(line, column, "the cell is empty", "Write the number, 0 for no load, or delete the row")
        if allow_missing and is_missing(cell):
            return math.nan
        value = parse_number(cell, self.decimal_comma, self.has_groups)
        if value is None:
            raise self.error(line, column, f"`{cell[:40]}` is not a number", self._remedy(cell))
        if not math.isfinite(value):
            raise self.error(line, column, f"`{cell[:40]}` is not finite", "Correct it, or delete the row")
        return value

    def _remedy(self, cell: str) -> str:
        """What to do about a cell that is no number in this table."""
        if not self.has_groups and parse_number(cell, self.decimal_comma, True) is not None:
            return "Write it without signs between thousands"
        other = parse_number(cell, not self.decimal_comma)
        return "Use either decimal points or decimal commas in a table" if other is not None else "Correct it"


def parse_number(cell: str, decimal_comma: bool = False, has_groups: bool = False) -> float | None:
    """The number that a cell holds (`1.5`, `-2,5`, `1.0D-03`, with groups `1,234.5`), or None."""
    text = CLEAR_GROUP_SIGN.sub("", cell.replace("\N{MINUS SIGN}", "-"))
    if has_groups and is_grouped(text, "," if decimal_comma else "."):
        text = re.sub(r"[ .]" if decimal_comma else r"[ ,]", "", text)
    if decimal_comma:
        text = text.replace(",", ".") if "." not in text else "x"
    if "_" in text:
        return None
    try:
        return float(re.sub(r"(?<=[\d.])[dD](?=[+-]?\d)", "e", text))
    except ValueError:
        return None


def read_table(path: Path) -> TextTable:
    """Read a table; raises UserError where the file is something else, or its lines have unequal columns."""
    content = _read_bytes(path)
    lines = [
        (number, line) for number, line in enumerate(_decode(path, content).splitlines(), 1) if not is_remark(line)
    ]
    rows = _split_lines(path, lines)
    first = _first_data_row(path, rows)
    header_at, units = _find_header(path, rows, first)
    header = _unique_header(path, rows[header_at])
    repeated = {cells for _, cells in rows[header_at:first]}
    below = [(line, cells) for line, cells in rows[first:] if any(cells) and cells not in repeated]
    decimal_comma, has_groups = _number_signs([cells[: len(header)] for _, cells in below])
    points, others = separate_rows(below, len(header), lambda cell: parse_number(cell, decimal_comma, has_groups))
    require_even_rows(path, points, header, rows[header_at])
    return TextTable(
        path=path,
        header=header,
        units=units,
        rows=tuple((line, cells[: len(header)]) for line, cells in points),
        decimal_comma=decimal_comma,
        digest=hashlib.sha256(content).hexdigest(),
        has_groups=has_groups,
        other_rows=tuple(others),
        unnamed=unnamed_columns(points, header),
    )


def _read_bytes(path: Path) -> bytes:
    require_file(path)
    if not path.is_file() or is_hdf5(path):
        raise UserError(f"is {describe_file(path)}, where a table was expected", str(path), remedy="Give a CSV file")
    try:
        if path.stat().st_size > MAX_BYTES:
            raise UserError("is too large for a table of load points", str(path), remedy="Split it")
        content = path.read_bytes()
    except OSError as error:
        reason = error.strerror or str(error)
        raise UserError(f"cannot be read: {reason}", str(path), remedy="Check its permissions") from error
    require_plain_text(content, path)
    return content


def _decode(path: Path, content: bytes) -> str:
    """The text, of the encoding that its bytes tell."""
    text = content.decode(find_encoding(content), "replace")
    if "\0" in text:
        raise UserError("is not a text file", str(path), remedy="Give a table as CSV")
    return text


def _split_lines(path: Path, lines: Sequence[tuple[int, str]]) -> list[Row]:
    """Split all lines by the first separator that gives most of them the same number of columns, with numbers."""
    if not lines:
        raise UserError("has no rows", str(path), remedy="Give a table with a head and rows of numbers")
    *signs, space = SEPARATORS
    faults: list[UserError] = []
    for separator in signs:
        if not any(separator in line for _, line in lines):
            continue
        try:
            rows = [(number, _cells(path, number, line, separator)) for number, line in lines]
        except UserError as fault:
            # A quoted cell that another sign follows: the lines may be separated by that one.
            faults.append(fault)
            continue
        numbers = [cells for _, cells in rows if any(_is_number(cell) for cell in cells)]
        width, count = Counter(map(len, numbers)).most_common(1)[0] if numbers else (0, 0)
        if width > 1 and count >= MIN_EVEN_SHARE * len(numbers) and any(map(_is_data, numbers)):
            return rows
    if faults:
        raise faults[0]
    rows = [(number, _cells(path, number, line, space)) for number, line in lines]
    if any(len(cells) > 1 and _is_data(cells) for _, cells in rows):
        return rows
    rows = [(number, (line.strip(),)) for number, line in lines]
    if sum(_is_data(cells) for _, cells in rows) >= MIN_COLUMN_ROWS:
        return rows
    remedy = "Separate the columns by commas, semicolons, tabs or spaces, in every line equally many"
    raise UserError("has no rows of numbers in columns", str(path), f"line {lines[0][0]}", remedy)


def _cells(path: Path, number: int, line: str, separator: str) -> tuple[str, ...]:
    if separator == " ":
        return tuple(line.split())
    try:
        return tuple(cell.strip() for cell in next(csv.reader([line], delimiter=separator, strict=True)))
    except csv.Error as error:
        fault = f"is not a line of a table: {error}"
        raise UserError(fault, str(path), f"line {number}", "Save it as CSV, quotes in pairs") from error


def _is_data(cells: Sequence[str]) -> bool:
    """Whether most cells are numbers, with a point or a comma."""
    filled = [cell for cell in cells if cell]
    numbers = [cell for cell in filled if _is_number(cell)]
    return bool(filled) and len(numbers) >= MIN_NUMBER_SHARE * len(filled)


def _is_number(cell: str) -> bool:
    """Whether a cell is a number, with a point or a comma."""
    return bool(cell) and any(parse_number(cell, comma, True) is not None for comma in (False, True))


def _first_data_row(path: Path, rows: Sequence[Row]) -> int:
    least = _least_width(rows)
    first = next(index for index, (_, cells) in enumerate(rows) if len(cells) >= least and _is_data(cells))
    if first == 0:
        fault = "begins with numbers: there is no head that names the columns"
        raise UserError(fault, str(path), f"line {rows[0][0]}", "Write a head such as `Fx [N],Fy [N],B1 [mV/V]`")
    return first


def _least_width(rows: Sequence[Row]) -> int:
    """Cells of a line of numbers or of the head at least: two, so that titles are told from them, if any line has."""
    return min(2, max(len(cells) for _, cells in rows))


def _find_header(path: Path, rows: Sequence[Row], first: int) -> tuple[int, tuple[str, ...]]:
    """Index of the head, and the units of a line between it and the numbers (empty where there is none)."""
    least = _least_width(rows)
    heads = [index for index in range(first) if sum(map(bool, rows[index][1])) >= least or _are_units(rows[index][1])]
    if not heads or 2 * len(rows[heads[-1]][1]) < len(rows[first][1]):
        fault = "is the line above the numbers, and does not name the columns"
        raise UserError(fault, str(path), f"line {rows[first - 1][0]}", "Write a name and a unit above each column")
    last = heads[-1]
    above = rows[last][1]
    names = rows[heads[-2]][1] if len(heads) > 1 else ()
    if len(names) == len(above) and (_are_units(above) or _are_units_of(above, names)):
        return heads[-2], tuple(cell.strip("[]() ") for cell in above)
    return last, ()


def _are_units(cells: Sequence[str]) -> bool:
    """Whether every cell that is filled is a unit."""
    filled = [cell.strip("[]() ") for cell in cells if cell.strip("[]() ")]
    return bool(filled) and all(is_unit(cell) for cell in filled)


def _are_units_of(cells: Sequence[str], names: Sequence[str]) -> bool:
    """Whether every cell that is filled is a unit, below different names some of which no load or reading has."""
    filled = [cell.strip("[]() ") for cell in cells if cell.strip("[]() /")]
    is_named = len(names) == len(cells) == len(set(filter(None, names)))
    return is_named and any(map(is_unit, filled)) and all(is_unit(cell) or is_other_unit(cell) for cell in filled)


def _unique_header(path: Path, row: Row) -> tuple[str, ...]:
    """The names of the columns, without the empty ones that spreadsheets append."""
    line, cells = row
    header = list(cells)
    while header and not header[-1]:
        header.pop()
    for name, count in Counter(header).items():
        if count > 1 and name:
            raise UserError(f"names two columns `{name}`", str(path), f"line {line}", "Give each column its own name")
    return tuple(header)


def _number_signs(rows: Sequence[Sequence[str]]) -> tuple[bool, bool]:
    """Whether numbers have a decimal comma, and whether some have a sign between thousands.

    They have a decimal comma where some cells do, and fewer have a decimal point. `1,234` alone can be either; beside
    `1,234.5` it is not.
    """
    cells = [cell for row in rows for cell in row]
    with_comma = sum(1 for cell in cells if "," in cell and (DECIMAL_COMMA.match(cell) or _has_both(cell, ",")))
    with_point = sum(1 for cell in cells if "." in cell and (parse_number(cell) is not None or _has_both(cell, ".")))
    decimal = "," if with_comma > with_point else "."
    return decimal == ",", any(_has_both(cell, decimal) for cell in cells if decimal in cell)


def _has_both(cell: str, decimal: str) -> bool:
    """Whether a cell is a number with signs between thousands and the decimal sign."""
    return decimal in cell and is_grouped(cell, decimal)
