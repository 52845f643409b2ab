"""Rows of a `balance-matrix/1` file: cells, numbers, and errors that name line, fault and remedy."""

from __future__ import annotations

import csv
import difflib
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.matrix_text import CORRELATION, FORMAT, READABLE_FORMAT
from balance_cli.io.errors import UserError
from balance_cli.io.formula_cells import name_of_cell

Array = NDArray[np.float64]

MAX_CELLS = 1000
"""Cells of a line from which the file is taken for something else; each channel needs one."""
SEMICOLON_REMEDY = "Save it with commas between cells and points in numbers"


@dataclass(frozen=True)
class MatrixRow:
    """One line of the file: line number, name, unit and values."""

    number: int
    name: str
    unit: str
    values: tuple[str, ...]

    def error(self, fault: str, remedy: str, column: str = "") -> UserError:
        """The error to raise for a fault in this line."""
        place = f"line {self.number}, `{self.name[:60]}`" + (f", {column}" if column else "")
        return UserError(fault, place=place, remedy=remedy)


def matrix_rows(text: str) -> list[MatrixRow]:
    """Split the text into rows, without blank lines and comments; the first line must name the format."""
    text = text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n")
    rows = [(number, row) for number, row in _parse_rows(text) if any(row) and not row[0].startswith("#")]
    if not rows:
        raise UserError("is empty", place="line 1", remedy=f"Its first line must be `{FORMAT}`")
    _check_format(*rows[0])
    if len(rows) > 1 and len(rows[1][1]) == 1 and ";" in rows[1][1][0]:
        raise UserError("is separated by semicolons", place=f"line {rows[1][0]}", remedy=SEMICOLON_REMEDY)
    return [MatrixRow(number, _row_name(row[0]), (*row, "")[1], tuple(row[2:])) for number, row in rows[1:]]


def _parse_rows(text: str) -> Iterator[tuple[int, list[str]]]:
    """Number of the line and cells of each row; a name in quotes may go on in the next line."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    number = 1
    while True:
        try:
            cells = next(reader)
        except StopIteration:
            return
        except csv.Error as error:
            fault = f"is not a line of a CSV file: {error}"
            raise UserError(fault, place=f"line {number}", remedy="Save it as CSV, quotes in pairs") from error
        yield number, _trim_cells(number, cells)
        number = reader.line_num + 1


def _trim_cells(number: int, row: Sequence[str]) -> list[str]:
    """Cells of a row, without the empty ones that spreadsheets append."""
    cells = [name_of_cell(cell.strip()) for cell in row]
    while cells and not cells[-1]:
        cells.pop()
    if len(cells) > MAX_CELLS:
        fault = f"has {len(cells)} cells, where at most {MAX_CELLS} are credible"
        raise UserError(fault, place=f"line {number}", remedy="Give each line of the matrix a line of the file")
    return cells


def _row_name(cell: str) -> str:
    """The name of a row, whose words may stand apart by any space; that of a channel at its end is left as it is."""
    if cell.startswith(CORRELATION):
        return cell
    return " ".join(cell.split())


def _check_format(number: int, cells: Sequence[str]) -> None:
    first_cell = cells[0]
    if first_cell == FORMAT:
        return
    place = f"line {number}"
    if first_cell.rstrip(";") == FORMAT:
        fault, remedy = "is separated by semicolons", SEMICOLON_REMEDY
    elif first_cell == READABLE_FORMAT:
        fault, remedy = "is the text for reading, which is rounded", "Give the matrix as .csv"
    elif first_cell.startswith("balance-matrix/"):
        fault, remedy = f"is of format `{first_cell[:40]}`, where `{FORMAT}` was expected", "Write it in that layout"
    else:
        fault, remedy = (
            f"begins with `{first_cell[:40]}`, where `{FORMAT}` was expected",
            "Give a matrix in that layout",
        )
    raise UserError(fault, place=place, remedy=remedy)


def parse_numbers(line: MatrixRow, columns: Sequence[str], limits: tuple[float, float] | None = None) -> Array:
    """Parse the values of a line, one for each column.

    Raises UserError for a missing or invalid value, or one outside `limits`.
    """
    check_value_count(line, columns)
    values = np.array([_parse_number(line, text, name) for text, name in zip(line.values, columns, strict=True)])
    if limits is not None:
        for value, name in zip(values, columns, strict=True):
            if not limits[0] <= value <= limits[1]:
                fault = f"{value:g} is not between {limits[0]:g} and {limits[1]:g}"
                raise line.error(fault, "Correct the number or its unit", name)
    return values


def check_value_count(line: MatrixRow, columns: Sequence[str]) -> None:
    """Raise UserError unless there is one value for each column."""
    if len(line.values) != len(columns):
        missing = f", `{columns[len(line.values)]}` is missing" if len(line.values) < len(columns) else ""
        fault = f"has {len(line.values)} values, where {len(columns)} are expected{missing}"
        raise line.error(fault, f"Give one for each of {', '.join(columns)}")


def _parse_number(line: MatrixRow, text: str, column: str) -> float:
    try:
        value = float(text) if "_" not in text else float("nan")
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise line.error(f"`{text[:40]}` is not a number", "Write it like -1.5e-3, and 0 where there is none", column)
    return value


def unit_error(line: MatrixRow, expected: str) -> UserError:
    """The error to raise where another unit, or none, was expected."""
    if not expected:
        return line.error(f"has the unit `{line.unit}`, where none was expected", "Leave the second cell empty")
    fault = f"has the unit `{line.unit}`, where `{expected}` was expected"
    return line.error(fault, f"Convert the values to {expected}, and write that unit in the second cell")


def suggest_name(name: str, known: Sequence[str]) -> str:
    """Suggest the known name nearest to a misspelled one, or list some of them."""
    near = difflib.get_close_matches(name[:100], known, n=1)
    return f"Did you mean `{near[0]}`?" if near else f"Known are {', '.join(known[:20])}"
