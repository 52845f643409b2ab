"""Whether a text file is one table: no other block of rows above it, and one way of writing numbers throughout."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from contextlib import suppress

from balance_cli.importers.text_clock import CLOCK
from balance_cli.io.errors import UserError
from balance_cli.io.text_format import REMARKS, SEPARATORS
from balance_cli.io.text_numbers import is_grouped, is_missing, is_number

FEWEST_BLOCK_ROWS = 5
"""Rows of numbers above the names of a table that are a table of their own; heads have fewer, with words."""
FEWEST_FRACTIONS = 2
"""Fractions directly above the data by which these rows are data, too: a head may state a single one."""
FEWEST_OTHER_ROWS = 2
"""Such rows with another separator: a line of a head may hold as many numbers as there are columns."""
_THREE_DECIMALS = re.compile(r"[.,]\d{3}$")

_SIGN_APART = re.compile(r"^([-+]) +(?=[\d.,])")
"""A sign with blanks before the digits, as loggers of Graphtec write it: `+ 24.1`."""
_STAMP = re.compile(r"^(\d{1,2}:\d{2}:\d{2}(?:\.\d+)?) -> ")
"""The time that the monitor of Arduino writes before each line."""

Rows = Sequence[Sequence[str]]


def split_cells(line: str, separator: str) -> list[str]:
    """The cells of a row, without quotes, outer spaces, and spaces between a sign and its number."""
    if " -> " in line and (stamp := _STAMP.match(line)):
        return [stamp[1], *split_cells(line[stamp.end() :], separator)]
    cells = _split(line, separator)
    return [_SIGN_APART.sub(r"\1", cell) for cell in cells] if "- " in line or "+ " in line else cells


def with_cells_apart(text: bytes, separator: str) -> bytes:
    """The rows of a text as `split_cells` reads them: a separator behind the time of a monitor, no space in numbers."""
    if b" -> " in text:
        stamp = _STAMP.pattern.encode("latin-1")
        text = re.sub(stamp, rb"\1" + re.escape(separator.encode("latin-1")), text, flags=re.MULTILINE)
    if separator != " " and (b"- " in text or b"+ " in text):
        edge = b"(?:^|(?<=[" + re.escape(separator.encode("latin-1")) + b'" ]))'
        text = re.sub(edge + rb"([-+]) +(?=[\d.,])", rb"\1", text, flags=re.MULTILINE)
    return text


def _split(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.replace('"', "").split()
    if '"' in line:
        with suppress(csv.Error):  # a cell of more than 131072 characters, with a quote without its partner
            return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]
    return [cell.strip() for cell in line.split(separator)]


def require_one_block(header: Rows, decimal: str) -> None:
    """Raise UserError where rows of numbers stand above the names: the table found is not the first one of the file."""
    run = 0
    for row, cells in enumerate(header):
        values = [cell for cell in cells if not is_missing(cell)]
        run = run + 1 if len(values) > 1 and _are_numbers(values, decimal) else 0
        if run == FEWEST_BLOCK_ROWS:
            last = header[-1]
            if last and last[0].startswith(REMARKS) and len(header) > 1 and _is_row(header[-2], decimal):
                fault = f"the remark `{' '.join(last)[:40]}` stands within the data"
                remedy = "Remove this row if the samples go on without a gap, or save what is below as another file"
                raise UserError(fault, place=f"row {len(header)}", remedy=remedy)
            fault = f"has several blocks of rows, one from row {row + 2 - run} and one behind row {len(header)}"
            remedy = "Save each block as a file of its own, or state `first_row` of the last one under `text`"
            raise UserError(fault, remedy=remedy)


def require_one_notation(lines: Sequence[str], first: int, separator: str, decimal: str) -> None:
    """Raise UserError where the rows above row `first` are data with another decimal sign, or another separator."""
    width = len(split_cells(lines[first], separator))
    other = _other_sign(decimal)
    above = [k for k in range(first) if lines[k].strip()]
    for own, sign in [(separator, other), *((own, sign) for own in SEPARATORS for sign in ".," if own != separator)]:
        fractions, run = 0, 0
        for k in reversed(above):
            values = [cell for cell in split_cells(lines[k], own) if not is_missing(cell)]
            if own == sign or len(split_cells(lines[k], own)) != width or not _are_numbers(values, sign):
                break
            fractions, run = fractions + sum(sign in cell for cell in values), run + 1
        if fractions >= FEWEST_FRACTIONS and run >= (1 if own == separator else FEWEST_OTHER_ROWS):
            what = f"`{sign}` for decimals, and the rows below it `{decimal}`"
            what = what if own == separator else "other separators than the rows below it"
            fault = f"`{lines[above[-1]].strip()[:40]}` has {what}"
            remedy = "Write all rows alike, or state `first_row` under `text` where the data are those below alone"
            raise UserError(fault, place=f"row {above[-1] + 1}", remedy=remedy)


def require_one_sign(rows: Rows, first: int, decimal: str, columns: Sequence[tuple[int, str]]) -> None:
    """Raise UserError where a column has `12.345` in some rows and `12,345` in others, which is then no thousand.

    `rows` are those of data, from row `first` (from 0) on, `columns` the columns of numbers with their names.
    """
    other = _other_sign(decimal)
    for column, name in columns:
        cells = [(k, row[column]) for k, row in enumerate(rows) if len(row) > column]
        marked = [(k, cell) for k, cell in cells if decimal in cell or other in cell]
        changed = next((k for k, cell in marked if (decimal in cell) != (decimal in marked[0][1])), None)
        are_short = all(_THREE_DECIMALS.search(cell) and not (decimal in cell and other in cell) for _, cell in marked)
        if changed is None or not are_short:
            continue
        if all(is_grouped(cell, decimal) for _, cell in marked if other in cell):
            cell, above = rows[changed][column], marked[0][1]
            fault = f"`{cell}` has another decimal sign than `{above}` above, or a sign between thousands"
            remedy = "Write all rows alike, or state `decimal` under `text` in the map"
            raise UserError(fault, place=f"row {first + changed + 1}, column `{name}`", remedy=remedy)


def _is_row(cells: Sequence[str], decimal: str) -> bool:
    return _are_numbers([cell for cell in cells if not is_missing(cell)], decimal)


def _are_numbers(values: Sequence[str], decimal: str) -> bool:
    """Whether there are cells, all of them numbers with this decimal sign or times."""
    return bool(values) and all(is_number(cell, decimal) or CLOCK.match(cell) for cell in values)


def _other_sign(decimal: str) -> str:
    return "," if decimal == "." else "."
