"""The reader of `balance-matrix/1`: a matrix from its CSV text, or one message that names line, fault and remedy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.matrix import Matrix, full_range_terms, term_unit
from balance_cli.calibration.matrix_rows import MatrixLine, check_count, matrix_lines, nearest, numbers, wrong_unit
from balance_cli.calibration.matrix_text import (
    CHANNEL,
    COMPONENT,
    CORRELATION,
    DOF,
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
from balance_cli.campaign.rig.components import COMPONENTS, UNIT_OF
from balance_cli.io.errors import UserError

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


@dataclass(frozen=True)
class StatedMatrix:
    """A matrix as read, with the number of the line in which each part stands."""

    matrix: Matrix
    line: Mapping[str, int]


def read_matrix(text: str) -> StatedMatrix:
    """The matrix that a CSV text states. UserError with place, fault and remedy where it is none."""
    lines = matrix_lines(text)
    header, terms = _parts(lines)
    components = _components(header)
    channels = _channels(header)
    k, c = len(components), len(channels)
    loads = {name: numbers(header[name], components, CREDIBLE[name]) for name in (FULL_RANGE, SMALLEST, LARGEST)}
    _check_range(header[LARGEST], components, loads[SMALLEST], loads[LARGEST])
    stated = {name: numbers(header[name], channels, CREDIBLE[name]) for name in (ZERO, RESIDUAL, DOF)}
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
        coefficients=np.array([numbers(row, channels) for row in rows]).reshape(2 * k * (k + 2), c),
    )
    _check_sizes(rows, matrix)
    _check_told_apart(rows[0], matrix)
    return StatedMatrix(matrix, {line.name: line.number for line in (*header.values(), *terms)})


def _parts(lines: Sequence[MatrixLine]) -> tuple[dict[str, MatrixLine], list[MatrixLine]]:
    """The lines before the terms, by name, and those from the head of the terms on."""
    start = next((i for i, line in enumerate(lines) if line.name == TERM), None)
    if start is None:
        remedy = "It is followed by the channels, and the terms stand below it"
        place = f"line {lines[-1].number if lines else 1}, the last"
        raise UserError(f"there is no line `{TERM}`", place=place, remedy=remedy)
    header: dict[str, MatrixLine] = {}
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


def _check_header(line: MatrixLine) -> None:
    """UserError for a name that no line of the header has, or a wrong unit."""
    if line.name not in HEADER and not line.name.startswith(CORRELATION):
        raise line.error("is no line of the header", f"{nearest(line.name, HEADER)}; comments begin with #")
    expected = VOLT if line.name in IN_VOLTS else ""
    if line.unit != expected:
        raise wrong_unit(line, expected)


# ---- header ----------------------------------------------------------------------------------------------------------


def _rig(header: Mapping[str, MatrixLine]) -> str:
    return header[RIG].values[0] if RIG in header and header[RIG].values else ""


def _components(header: Mapping[str, MatrixLine]) -> tuple[str, ...]:
    """The components, each with the unit that it has here."""
    line, units = header[COMPONENT], header[UNIT]
    _check_names(line)
    for name in line.values:
        if name not in COMPONENTS:
            raise line.error(f"`{name}` is no load component", f"Known are {', '.join(COMPONENTS)}")
    check_count(units, line.values)
    for name, unit in zip(line.values, units.values, strict=True):
        if unit.split() != UNIT_OF[name].split():
            fault = f"`{unit}`, where `{UNIT_OF[name]}` was expected"
            raise units.error(fault, "Convert loads and coefficients to N and N m", name)
    return line.values


def _channels(header: Mapping[str, MatrixLine]) -> tuple[str, ...]:
    line = header[CHANNEL]
    _check_names(line)
    if len(line.values) < len(header[COMPONENT].values):
        fault = f"{len(line.values)} channels cannot determine {len(header[COMPONENT].values)} loads"
        raise line.error(fault, "Give as many channels as components at least")
    return line.values


def _check_names(line: MatrixLine) -> None:
    """UserError unless there are names, each once."""
    if not line.values:
        raise line.error("names nothing", "Give the names from the third cell on")
    for i, name in enumerate(line.values):
        if not name:
            raise line.error("a name is empty", "Give every column a name", f"value {i + 1}")
        if name in line.values[:i]:
            raise line.error(f"`{name}` is there twice", "Give every column a name of its own")


def _check_columns(line: MatrixLine, channels: tuple[str, ...]) -> None:
    """UserError unless the columns of the terms are the channels of the header."""
    if line.unit != UNIT:
        raise line.error(f"`{line.unit}` is in the second cell, where `{UNIT}` was expected", f"Write `{UNIT}` there")
    for name in channels:
        if name not in line.values:
            raise line.error(f"channel `{name}` is missing", f"Give it a column here, or take it out of `{CHANNEL}`")
    check_count(line, channels)
    if line.values != channels:
        raise line.error(f"has the channels in another order than `{CHANNEL}`", "Write them in one order")


def _check_range(line: MatrixLine, components: Sequence[str], smallest: Array, largest: Array) -> None:
    for name, least, most in zip(components, smallest, largest, strict=True):
        if not least < most:
            fault = f"{most:g} is not above the smallest load {least:g}"
            raise line.error(fault, f"State the loads between which {name} was calibrated", name)


def _correlation(header: Mapping[str, MatrixLine], channels: tuple[str, ...]) -> Array:
    """Correlation (c, c) of the residuals; none where it is not stated."""
    lines = {name.removeprefix(CORRELATION): line for name, line in header.items() if name.startswith(CORRELATION)}
    for name, line in lines.items():
        if name not in channels:
            raise line.error(f"`{name}` is not among the channels", nearest(name, channels))
    if not lines:
        return np.eye(len(channels))
    for name in channels:
        if name not in lines:
            fault, remedy = f"there is no line `{CORRELATION}{name}`", "State it for all channels, or for none"
            raise UserError(fault, place=f"line {header[CHANNEL].number}, `{CHANNEL}`", remedy=remedy)
    found = np.array([numbers(lines[name], channels, (-1.0, 1.0)) for name in channels])
    for i, name in enumerate(channels):
        if abs(found[i, i] - 1.0) > SYMMETRIC or np.max(np.abs(found[i] - found[:, i])) > SYMMETRIC:
            raise lines[name].error("is not symmetric with 1 on the diagonal", "Correct it, or leave correlations out")
    if np.linalg.eigvalsh(found)[0] < LEAST_EIGENVALUE:
        fault = "the correlations contradict each other (not positive definite)"
        raise lines[channels[0]].error(fault, "Correct them, or leave correlations out")
    return found


# ---- terms -----------------------------------------------------------------------------------------------------------


def _terms(lines: Sequence[MatrixLine], components: tuple[str, ...], head: int) -> list[MatrixLine]:
    """The lines of all terms, in their usual order."""
    terms = {term.name(components): term for term in all_terms(len(components))}
    # Whether there is a space between two loads does not matter.
    plain = {_without_spaces(name): name for name in terms}
    found: dict[str, MatrixLine] = {}
    for line in lines:
        name = plain.get(_without_spaces(line.name))
        if name is None:
            raise line.error("is no term of these components", nearest(line.name, tuple(terms)))
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


def _check_unit(line: MatrixLine, term: Term, components: tuple[str, ...]) -> None:
    expected = term_unit(term, components)
    if _without_spaces(line.unit) != _without_spaces(expected):
        raise wrong_unit(line, expected)


def _check_sizes(lines: Sequence[MatrixLine], matrix: Matrix) -> None:
    """UserError for a coefficient that makes more at full range than any gage does."""
    at_full_range = full_range_terms(matrix.full_range)
    for line, coefficients, load in zip(lines, matrix.coefficients, at_full_range, strict=True):
        for name, value in zip(matrix.channel_names, coefficients, strict=True):
            if abs(value) > LARGEST_READING / load:
                fault = f"{value:g} makes more than {LARGEST_READING:g} V at full range"
                raise line.error(fault, "Correct the number or its unit", name)


def _check_told_apart(line: MatrixLine, matrix: Matrix) -> None:
    """UserError where the straight part does not determine the loads."""
    straight = matrix.coefficients[: len(matrix.components)].T * matrix.full_range
    s = np.linalg.svd(straight / matrix.residual_sigma[:, None], compute_uv=False)
    if s[-1] * LARGEST_CONDITION <= s[0]:
        fault = "the terms of first degree do not tell the loads apart"
        raise line.error(fault, "Correct them, or give the channels that are missing")
