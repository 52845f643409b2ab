"""The reader of `balance-matrix/1`: a matrix from its CSV text, or one message that names line, fault and remedy."""

from __future__ import annotations

import csv
import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.matrix import Matrix, full_range_terms, term_unit
from balance_cli.calibration.matrix_text import (
    CHANNEL,
    COMPONENT,
    CORRELATION,
    DOF,
    FOR_READING,
    FORMAT,
    FULL_RANGE,
    LARGEST,
    NOTE,
    RESIDUAL,
    RIG,
    SMALLEST,
    TERM,
    UNIT,
    VOLT,
    ZERO,
)
from balance_cli.calibration.terms import Term, all_terms
from balance_cli.components import COMPONENTS, UNIT_OF
from balance_cli.errors import UserError

Array = NDArray[np.float64]

REQUIRED = (COMPONENT, UNIT, FULL_RANGE, SMALLEST, LARGEST, CHANNEL, ZERO, RESIDUAL, DOF)
HEADER = (RIG, *REQUIRED)
IN_VOLTS = (ZERO, RESIDUAL)
CREDIBLE = {
    FULL_RANGE: (1e-6, 1e9),
    SMALLEST: (-1e9, 1e9),
    LARGEST: (-1e9, 1e9),
    ZERO: (-1e6, 1e6),
    RESIDUAL: (1e-12, 1e6),
    DOF: (1.0, 1e9),
}
"""Beyond these a number is a mistake of units or of typing."""
LARGEST_READING = 1e6
"""Volts that a term may make at full range."""
LARGEST_CONDITION = 1e8
LEAST_EIGENVALUE = 1e-12
SYMMETRIC = 1e-9
MOST_CELLS = 1000
SEMICOLONS = "Save it with commas between cells and points in numbers"


@dataclass(frozen=True)
class _Line:
    """One line of the file: its number, name, unit and values."""

    number: int
    name: str
    unit: str
    values: tuple[str, ...]

    def error(self, fault: str, remedy: str, column: str = "") -> UserError:
        """What is wrong in this line."""
        place = f"line {self.number}, `{self.name[:60]}`" + (f", {column}" if column else "")
        return UserError(fault, place=place, remedy=remedy)


@dataclass(frozen=True)
class StatedMatrix:
    """A matrix as read, with the number of the line in which each part stands."""

    matrix: Matrix
    line: Mapping[str, int]


def read_matrix(text: str) -> StatedMatrix:
    """The matrix that a CSV text states. UserError with place, fault and remedy where it is none."""
    lines = _lines(text)
    header, terms = _parts(lines)
    components = _components(header)
    channels = _channels(header)
    k, c = len(components), len(channels)
    loads = {name: _numbers(header[name], components, CREDIBLE[name]) for name in (FULL_RANGE, SMALLEST, LARGEST)}
    _check_range(header[LARGEST], components, loads[SMALLEST], loads[LARGEST])
    stated = {name: _numbers(header[name], channels, CREDIBLE[name]) for name in (ZERO, RESIDUAL, DOF)}
    _check_columns(terms[0], channels)
    rows = _terms(terms[1:], components, terms[0].number)
    matrix = Matrix(
        rig=_rig(header),
        components=components,
        full_range=loads[FULL_RANGE],
        smallest=loads[SMALLEST],
        largest=loads[LARGEST],
        channel_names=channels,
        zeros=stated[ZERO],
        residual_sigma=stated[RESIDUAL],
        dof=stated[DOF],
        correlation=_correlation(header, channels),
        coefficients=np.array([_numbers(row, channels) for row in rows]).reshape(2 * k * (k + 2), c),
    )
    _check_sizes(rows, matrix)
    _check_told_apart(rows[0], matrix)
    return StatedMatrix(matrix, {line.name: line.number for line in (*header.values(), *terms)})


# ---- lines -----------------------------------------------------------------------------------------------------------


def _lines(text: str) -> list[_Line]:
    """The lines that hold something, after the first, which must name the format."""
    numbered = enumerate(text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n").split("\n"), 1)
    cells = [(number, _cells(number, line)) for number, line in numbered]
    held = [(number, each) for number, each in cells if any(each) and not each[0].startswith("#")]
    if not held:
        raise UserError("holds nothing", place="line 1", remedy=f"Its first line must be `{FORMAT}`")
    _check_format(*held[0])
    if len(held) > 1 and len(held[1][1]) == 1 and ";" in held[1][1][0]:
        raise UserError("is separated by semicolons", place=f"line {held[1][0]}", remedy=SEMICOLONS)
    return [_Line(number, " ".join(each[0].split()), (*each, "")[1], tuple(each[2:])) for number, each in held[1:]]


def _cells(number: int, line: str) -> list[str]:
    """The cells of a line, without the empty ones that a spreadsheet appends."""
    try:
        cells = [cell.strip() for cell in next(csv.reader([line], strict=True), [])]
    except csv.Error as error:
        fault = f"is no line of a CSV file: {error}"
        raise UserError(fault, place=f"line {number}", remedy="Save it as CSV, quotes in pairs") from error
    while cells and not cells[-1]:
        cells.pop()
    if len(cells) > MOST_CELLS:
        fault = f"has {len(cells)} cells, where at most {MOST_CELLS} are credible"
        raise UserError(fault, place=f"line {number}", remedy="Give each line of the matrix a line of the file")
    return cells


def _check_format(number: int, cells: Sequence[str]) -> None:
    found = cells[0]
    if found == FORMAT:
        return
    place = f"line {number}"
    if found.rstrip(";") == FORMAT:
        fault, remedy = "is separated by semicolons", SEMICOLONS
    elif found == FOR_READING:
        fault, remedy = "is the text for reading, which is rounded", "Give the matrix as .csv"
    elif found.startswith("balance-matrix/"):
        fault, remedy = f"is of format `{found[:40]}`, where `{FORMAT}` was expected", "Write it in that layout"
    else:
        fault, remedy = f"begins with `{found[:40]}`, where `{FORMAT}` was expected", "Give a matrix in that layout"
    raise UserError(fault, place=place, remedy=remedy)


def _parts(lines: Sequence[_Line]) -> tuple[dict[str, _Line], list[_Line]]:
    """The lines before the terms, by name, and those from the head of the terms on."""
    start = next((i for i, line in enumerate(lines) if line.name == TERM), None)
    if start is None:
        remedy = "It is followed by the channels, and the terms stand below it"
        place = f"line {lines[-1].number if lines else 1}, the last"
        raise UserError(f"there is no line `{TERM}`", place=place, remedy=remedy)
    header: dict[str, _Line] = {}
    for line in lines[:start]:
        if line.name == NOTE:
            continue
        if line.name in header:
            raise line.error(f"is there twice, first in line {header[line.name].number}", "Keep one of them")
        _check_header(line)
        header[line.name] = line
    for name in REQUIRED:
        if name not in header:
            place = f"line {lines[start].number}, before `{TERM}`"
            raise UserError(f"there is no line `{name}`", place=place, remedy="State it in the header")
    return header, list(lines[start:])


def _check_header(line: _Line) -> None:
    """UserError for a name that no line of the header has, or a wrong unit."""
    if line.name not in HEADER and not line.name.startswith(CORRELATION):
        raise line.error("is no line of the header", f"{_nearest(line.name, HEADER)}; comments begin with #")
    expected = VOLT if line.name in IN_VOLTS else ""
    if line.unit != expected:
        raise _wrong_unit(line, expected)


def _wrong_unit(line: _Line, expected: str) -> UserError:
    if not expected:
        return line.error(f"has the unit `{line.unit}`, where none stands", "Leave the second cell empty")
    fault = f"has the unit `{line.unit}`, where `{expected}` was expected"
    return line.error(fault, f"Convert the values to {expected}, and write so in the second cell")


def _nearest(name: str, known: Sequence[str]) -> str:
    near = difflib.get_close_matches(name[:100], known, n=1)
    return f"Did you mean `{near[0]}`?" if near else f"Known are {', '.join(known[:20])}"


# ---- header ----------------------------------------------------------------------------------------------------------


def _rig(header: Mapping[str, _Line]) -> str:
    return header[RIG].values[0] if RIG in header and header[RIG].values else ""


def _components(header: Mapping[str, _Line]) -> tuple[str, ...]:
    """The components, each with the unit that it has here."""
    line, units = header[COMPONENT], header[UNIT]
    _check_names(line)
    for name in line.values:
        if name not in COMPONENTS:
            raise line.error(f"`{name}` is no load component", f"Known are {', '.join(COMPONENTS)}")
    _check_count(units, line.values)
    for name, unit in zip(line.values, units.values, strict=True):
        if unit.split() != UNIT_OF[name].split():
            fault = f"`{unit}`, where `{UNIT_OF[name]}` was expected"
            raise units.error(fault, "Convert loads and coefficients to N and N m", name)
    return line.values


def _channels(header: Mapping[str, _Line]) -> tuple[str, ...]:
    line = header[CHANNEL]
    _check_names(line)
    if len(line.values) < len(header[COMPONENT].values):
        fault = f"{len(line.values)} channels cannot determine {len(header[COMPONENT].values)} loads"
        raise line.error(fault, "Give as many channels as components at least")
    return line.values


def _check_names(line: _Line) -> None:
    """UserError unless there are names, each once."""
    if not line.values:
        raise line.error("names nothing", "Give the names from the third cell on")
    for i, name in enumerate(line.values):
        if not name:
            raise line.error("a name is empty", "Give every column a name", f"value {i + 1}")
        if name in line.values[:i]:
            raise line.error(f"`{name}` is there twice", "Give every column a name of its own")


def _check_columns(line: _Line, channels: tuple[str, ...]) -> None:
    """UserError unless the columns of the terms are the channels of the header."""
    if line.unit != UNIT:
        raise line.error(f"`{line.unit}` is in the second cell, where `{UNIT}` was expected", f"Write `{UNIT}` there")
    for name in channels:
        if name not in line.values:
            raise line.error(f"channel `{name}` is missing", f"Give it a column here, or take it out of `{CHANNEL}`")
    _check_count(line, channels)
    if line.values != channels:
        raise line.error(f"has the channels in another order than `{CHANNEL}`", "Write them in one order")


def _check_range(line: _Line, components: Sequence[str], smallest: Array, largest: Array) -> None:
    for name, least, most in zip(components, smallest, largest, strict=True):
        if not least < most:
            fault = f"{most:g} is not above the smallest load {least:g}"
            raise line.error(fault, f"State the loads between which {name} was calibrated", name)


def _correlation(header: Mapping[str, _Line], channels: tuple[str, ...]) -> Array:
    """Correlation (c, c) of the residuals; none where it is not stated."""
    lines = {name.removeprefix(CORRELATION): line for name, line in header.items() if name.startswith(CORRELATION)}
    for name, line in lines.items():
        if name not in channels:
            raise line.error(f"`{name}` is not among the channels", _nearest(name, channels))
    if not lines:
        return np.eye(len(channels))
    for name in channels:
        if name not in lines:
            fault, remedy = f"there is no line `{CORRELATION}{name}`", "State it for all channels, or for none"
            raise UserError(fault, place=f"line {header[CHANNEL].number}, `{CHANNEL}`", remedy=remedy)
    found = np.array([_numbers(lines[name], channels, (-1.0, 1.0)) for name in channels])
    for i, name in enumerate(channels):
        if abs(found[i, i] - 1.0) > SYMMETRIC or np.max(np.abs(found[i] - found[:, i])) > SYMMETRIC:
            raise lines[name].error("is not symmetric with 1 on the diagonal", "Correct it, or leave correlations out")
    if np.linalg.eigvalsh(found)[0] < LEAST_EIGENVALUE:
        fault = "the correlations contradict each other (not positive definite)"
        raise lines[channels[0]].error(fault, "Correct them, or leave correlations out")
    return found


# ---- numbers ---------------------------------------------------------------------------------------------------------


def _numbers(line: _Line, columns: Sequence[str], credible: tuple[float, float] | None = None) -> Array:
    """The values of a line, one for each column."""
    _check_count(line, columns)
    values = np.array([_number(line, text, name) for text, name in zip(line.values, columns, strict=True)])
    if credible is not None:
        for value, name in zip(values, columns, strict=True):
            if not credible[0] <= value <= credible[1]:
                fault = f"{value:g} is not between {credible[0]:g} and {credible[1]:g}"
                raise line.error(fault, "Correct the number or its unit", name)
    return values


def _check_count(line: _Line, columns: Sequence[str]) -> None:
    if len(line.values) != len(columns):
        missing = f", `{columns[len(line.values)]}` is missing" if len(line.values) < len(columns) else ""
        fault = f"has {len(line.values)} values, where {len(columns)} are expected{missing}"
        raise line.error(fault, f"Give one for each of {', '.join(columns)}")


def _number(line: _Line, text: str, column: str) -> float:
    try:
        value = float(text) if "_" not in text else float("nan")
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise line.error(f"`{text[:40]}` is not a number", "Write it like -1.5e-3, and 0 where there is none", column)
    return value


# ---- terms -----------------------------------------------------------------------------------------------------------


def _terms(lines: Sequence[_Line], components: tuple[str, ...], head: int) -> list[_Line]:
    """The lines of all terms, in their usual order."""
    terms = {term.name(components): term for term in all_terms(len(components))}
    # Whether there is a space between two loads does not matter.
    plain = {_without_spaces(name): name for name in terms}
    found: dict[str, _Line] = {}
    for line in lines:
        name = plain.get(_without_spaces(line.name))
        if name is None:
            raise line.error("is no term of these components", _nearest(line.name, tuple(terms)))
        if name in found:
            raise line.error(f"is there twice, first in line {found[name].number}", "Keep one of them")
        _check_unit(line, terms[name], components)
        found[name] = line
    for name in terms:
        if name not in found:
            remedy = "Write a line for each term, of zeros where no channel has it"
            raise UserError(f"there is no line for the term `{name}`", place=f"below line {head}", remedy=remedy)
    return [found[name] for name in terms]


def _without_spaces(text: str) -> str:
    return "".join(text.split())


def _check_unit(line: _Line, term: Term, components: tuple[str, ...]) -> None:
    expected = term_unit(term, components)
    if _without_spaces(line.unit) != _without_spaces(expected):
        raise _wrong_unit(line, expected)


def _check_sizes(lines: Sequence[_Line], matrix: Matrix) -> None:
    """UserError for a coefficient that makes more at full range than any gage does."""
    at_full_range = full_range_terms(matrix.full_range)
    for line, coefficients, load in zip(lines, matrix.coefficients, at_full_range, strict=True):
        for name, value in zip(matrix.channel_names, coefficients, strict=True):
            if abs(value) > LARGEST_READING / load:
                fault = f"{value:g} makes more than {LARGEST_READING:g} V at full range"
                raise line.error(fault, "Correct the number or its unit", name)


def _check_told_apart(line: _Line, matrix: Matrix) -> None:
    """UserError where the straight part does not determine the loads."""
    straight = matrix.coefficients[: len(matrix.components)].T * matrix.full_range
    s = np.linalg.svd(straight / matrix.residual_sigma[:, None], compute_uv=False)
    if s[-1] * LARGEST_CONDITION <= s[0]:
        fault = "the terms of first degree do not tell the loads apart"
        raise line.error(fault, "Correct them, or give the channels that are missing")
