"""Lines of a `balance-matrix/1` file: cells, numbers, and messages that name line, fault and remedy."""

from __future__ import annotations

import csv
import difflib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.matrix_text import FORMAT, READABLE_FORMAT
from balance_cli.io.errors import UserError

Array = NDArray[np.float64]

MAX_CELLS = 1000
SEMICOLON_REMEDY = "Save it with commas between cells and points in numbers"


@dataclass(frozen=True)
class MatrixRow:
    """One line of the file: its number, name, unit and values."""

    number: int
    name: str
    unit: str
    values: tuple[str, ...]

    def error(self, fault: str, remedy: str, column: str = "") -> UserError:
        """What is wrong in this line."""
        place = f"line {self.number}, `{self.name[:60]}`" + (f", {column}" if column else "")
        return UserError(fault, place=place, remedy=remedy)


def matrix_rows(text: str) -> list[MatrixRow]:
    """The lines that hold something, after the first, which must name the format."""
    numbered = enumerate(text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n").split("\n"), 1)
    cells = [(number, _parse_cells(number, line)) for number, line in numbered]
    held = [(number, each) for number, each in cells if any(each) and not each[0].startswith("#")]
    if not held:
        raise UserError("holds nothing", place="line 1", remedy=f"Its first line must be `{FORMAT}`")
    _check_format(*held[0])
    if len(held) > 1 and len(held[1][1]) == 1 and ";" in held[1][1][0]:
        raise UserError("is separated by semicolons", place=f"line {held[1][0]}", remedy=SEMICOLON_REMEDY)
    return [MatrixRow(number, " ".join(each[0].split()), (*each, "")[1], tuple(each[2:])) for number, each in held[1:]]


def _parse_cells(number: int, line: str) -> list[str]:
    """The cells of a line, without the empty ones that a spreadsheet appends."""
    try:
        cells = [cell.strip() for cell in next(csv.reader([line], strict=True), [])]
    except csv.Error as error:
        fault = f"is no line of a CSV file: {error}"
        raise UserError(fault, place=f"line {number}", remedy="Save it as CSV, quotes in pairs") from error
    while cells and not cells[-1]:
        cells.pop()
    if len(cells) > MAX_CELLS:
        fault = f"has {len(cells)} cells, where at most {MAX_CELLS} are credible"
        raise UserError(fault, place=f"line {number}", remedy="Give each line of the matrix a line of the file")
    return cells


def _check_format(number: int, cells: Sequence[str]) -> None:
    found = cells[0]
    if found == FORMAT:
        return
    place = f"line {number}"
    if found.rstrip(";") == FORMAT:
        fault, remedy = "is separated by semicolons", SEMICOLON_REMEDY
    elif found == READABLE_FORMAT:
        fault, remedy = "is the text for reading, which is rounded", "Give the matrix as .csv"
    elif found.startswith("balance-matrix/"):
        fault, remedy = f"is of format `{found[:40]}`, where `{FORMAT}` was expected", "Write it in that layout"
    else:
        fault, remedy = f"begins with `{found[:40]}`, where `{FORMAT}` was expected", "Give a matrix in that layout"
    raise UserError(fault, place=place, remedy=remedy)


def parse_numbers(line: MatrixRow, columns: Sequence[str], limits: tuple[float, float] | None = None) -> Array:
    """The values of a line, one for each column."""
    check_value_count(line, columns)
    values = np.array([_parse_number(line, text, name) for text, name in zip(line.values, columns, strict=True)])
    if limits is not None:
        for value, name in zip(values, columns, strict=True):
            if not limits[0] <= value <= limits[1]:
                fault = f"{value:g} is not between {limits[0]:g} and {limits[1]:g}"
                raise line.error(fault, "Correct the number or its unit", name)
    return values


def check_value_count(line: MatrixRow, columns: Sequence[str]) -> None:
    """UserError unless there is one value for each column."""
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
    """What to say where another unit, or none, was expected."""
    if not expected:
        return line.error(f"has the unit `{line.unit}`, where none stands", "Leave the second cell empty")
    fault = f"has the unit `{line.unit}`, where `{expected}` was expected"
    return line.error(fault, f"Convert the values to {expected}, and write so in the second cell")


def suggest_name(name: str, known: Sequence[str]) -> str:
    """The known name that was perhaps meant, or some of them."""
    near = difflib.get_close_matches(name[:100], known, n=1)
    return f"Did you mean `{near[0]}`?" if near else f"Known are {', '.join(known[:20])}"
