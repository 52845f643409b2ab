"""Parser of `balance-matrix/1`: a matrix from its CSV text, or an error that names line, fault and remedy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.matrix import CalibrationMatrix, term_unit, terms_at_calibrated_range
from balance_cli.calibration.matrix_rows import (
    MatrixRow,
    check_value_count,
    matrix_rows,
    parse_numbers,
    suggest_name,
    unit_error,
)
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
    ZERO,
)
from balance_cli.calibration.terms import Term, all_terms
from balance_cli.campaign.rig.components import COMPONENTS, UNIT_OF
from balance_cli.io.errors import UserError
from balance_cli.io.units import NUMBER, RATIO, VOLTAGE

Array = NDArray[np.float64]

REQUIRED = (COMPONENT, UNIT, FULL_RANGE, SMALLEST, LARGEST, CHANNEL, ZERO, RESIDUAL, DOF)
HEADER = (RIG, *REQUIRED)
READING_ROWS = (ZERO, RESIDUAL)
READING_UNITS = (VOLTAGE, RATIO, NUMBER)
CREDIBLE_LIMITS = {
    FULL_RANGE: (1e-6, 1e9),
    SMALLEST: (-1e9, 1e9),
    LARGEST: (-1e9, 1e9),
    ZERO: (-1e6, 1e6),
    RESIDUAL: (1e-12, 1e6),
    DOF: (1.0, 1e9),
}
"""Limits far beyond any balance: a number outside them has the wrong unit or a typing error."""
MAX_READING = 1e6
"""Largest contribution of a term at the calibrated range [V]; beyond it the coefficient is a mistake."""
LARGEST_COUNT = 1e10
"""The same of a channel in counts, and its largest zero: converters have 32 bits at most."""
MAX_LINEAR_CONDITION = 1e8
"""Condition of the linear part from which it does not determine the loads: half the digits of double precision."""
MIN_EIGENVALUE = 1e-12
"""Least eigenvalue of a correlation matrix that counts as positive definite in double precision."""
SYMMETRY_TOLERANCE = 1e-9
"""Difference from a symmetric correlation matrix with unit diagonal that printing to ten digits may cause."""


@dataclass(frozen=True)
class ParsedMatrix:
    """A matrix as read, with the line number of each row by its name."""

    matrix: CalibrationMatrix
    line: Mapping[str, int]


def read_matrix(text: str) -> ParsedMatrix:
    """Parse the CSV text of a matrix.

    Raises UserError, with place, fault and remedy, where the text is not a valid matrix.
    """
    lines = matrix_rows(text)
    header, terms = _split_sections(lines)
    components = _component_names(header)
    channels = _channel_names(header)
    k, c = len(components), len(channels)
    loads = {
        name: parse_numbers(header[name], components, CREDIBLE_LIMITS[name]) for name in (FULL_RANGE, SMALLEST, LARGEST)
    }
    _check_range(header[LARGEST], components, loads[SMALLEST], loads[LARGEST])
    unit = _reading_unit(header)
    limits = CREDIBLE_LIMITS | ({ZERO: (-LARGEST_COUNT, LARGEST_COUNT)} if unit == NUMBER else {})
    stated = {name: parse_numbers(header[name], channels, limits[name]) for name in (ZERO, RESIDUAL, DOF)}
    _check_columns(terms[0], channels)
    rows = _ordered_term_rows(terms[1:], components, terms[0].number, unit)
    matrix = CalibrationMatrix(
        rig=_rig_name(header),
        components=components,
        calibrated_range=loads[FULL_RANGE],
        smallest_load=loads[SMALLEST],
        largest_load=loads[LARGEST],
        channel_names=channels,
        zeros=stated[ZERO],
        residual_sigma=stated[RESIDUAL],
        dof=stated[DOF],
        correlation=_correlation(header, channels),
        coefficients=np.array([parse_numbers(row, channels) for row in rows]).reshape(2 * k * (k + 2), c),
        reading_unit=unit,
    )
    _check_magnitudes(rows, matrix)
    _check_conditioning(rows[0], matrix)
    return ParsedMatrix(matrix, {line.name: line.number for line in (*header.values(), *terms)})


def _split_sections(lines: Sequence[MatrixRow]) -> tuple[dict[str, MatrixRow], list[MatrixRow]]:
    """Split the rows into those of the header, by name, and those of the terms with their heading."""
    start = next((i for i, line in enumerate(lines) if line.name == TERM), None)
    if start is None:
        remedy = "It is followed by the channels, and the terms stand below it"
        place = f"line {lines[-1].number if lines else 1}, the last"
        raise UserError(f"there is no line `{TERM}`", place=place, remedy=remedy)
    header: dict[str, MatrixRow] = {}
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


def _check_header(line: MatrixRow) -> None:
    """Raise UserError for an unknown name in the header or a wrong unit."""
    if line.name not in HEADER and not line.name.startswith(CORRELATION):
        raise line.error("is not a line of the header", f"{suggest_name(line.name, HEADER)}; comments begin with #")
    if line.name in READING_ROWS and line.unit not in READING_UNITS:
        raise unit_error(line, VOLTAGE)
    if line.name not in READING_ROWS and line.unit:
        raise unit_error(line, "")


def _reading_unit(header: Mapping[str, MatrixRow]) -> str:
    """The base unit of the readings, which zeros and residuals state."""
    unit = header[ZERO].unit
    if header[RESIDUAL].unit != unit:
        raise unit_error(header[RESIDUAL], unit)
    return unit


# ---- header ----------------------------------------------------------------------------------------------------------


def _rig_name(header: Mapping[str, MatrixRow]) -> str:
    return header[RIG].values[0] if RIG in header and header[RIG].values else ""


def _component_names(header: Mapping[str, MatrixRow]) -> tuple[str, ...]:
    """Names of the components, whose units are checked."""
    line, units = header[COMPONENT], header[UNIT]
    _check_names(line)
    for name in line.values:
        if name not in COMPONENTS:
            raise line.error(f"`{name}` is not a load component", f"Known are {', '.join(COMPONENTS)}")
    check_value_count(units, line.values)
    for name, unit in zip(line.values, units.values, strict=True):
        if unit.split() != UNIT_OF[name].split():
            fault = f"`{unit}`, where `{UNIT_OF[name]}` was expected"
            raise units.error(fault, "Convert loads and coefficients to N and N m", name)
    return line.values


def _channel_names(header: Mapping[str, MatrixRow]) -> tuple[str, ...]:
    line = header[CHANNEL]
    _check_names(line)
    if len(line.values) < len(header[COMPONENT].values):
        fault = f"{len(line.values)} channels cannot determine {len(header[COMPONENT].values)} loads"
        raise line.error(fault, "Give as many channels as components at least")
    return line.values


def _check_names(line: MatrixRow) -> None:
    """Raise UserError unless there are names, each once."""
    if not line.values:
        raise line.error("names nothing", "Give the names from the third cell on")
    for i, name in enumerate(line.values):
        if not name:
            raise line.error("a name is empty", "Give every column a name", f"value {i + 1}")
        if name in line.values[:i]:
            raise line.error(f"`{name}` is there twice", "Give every column a name of its own")


def _check_columns(line: MatrixRow, channels: tuple[str, ...]) -> None:
    """Raise UserError unless the columns of the terms are the channels of the header."""
    if line.unit != UNIT:
        raise line.error(f"`{line.unit}` is in the second cell, where `{UNIT}` was expected", f"Write `{UNIT}` there")
    for name in channels:
        if name not in line.values:
            raise line.error(f"channel `{name}` is missing", f"Give it a column here, or take it out of `{CHANNEL}`")
    check_value_count(line, channels)
    if line.values != channels:
        raise line.error(f"has the channels in another order than `{CHANNEL}`", "Write them in one order")


def _check_range(line: MatrixRow, components: Sequence[str], smallest: Array, largest: Array) -> None:
    for name, least, most in zip(components, smallest, largest, strict=True):
        if not least < most:
            fault = f"{most:g} is not above the smallest load {least:g}"
            raise line.error(fault, f"State the loads between which {name} was calibrated", name)


def _correlation(header: Mapping[str, MatrixRow], channels: tuple[str, ...]) -> Array:
    """Correlation (c, c) of the residuals; the unit matrix where the file does not state it."""
    lines = {name.removeprefix(CORRELATION): line for name, line in header.items() if name.startswith(CORRELATION)}
    for name, line in lines.items():
        if name not in channels:
            raise line.error(f"`{name}` is not among the channels", suggest_name(name, channels))
    if not lines:
        return np.eye(len(channels))
    for name in channels:
        if name not in lines:
            fault, remedy = f"there is no line `{CORRELATION}{name}`", "State it for all channels, or for none"
            raise UserError(fault, place=f"line {header[CHANNEL].number}, `{CHANNEL}`", remedy=remedy)
    correlation = np.array([parse_numbers(lines[name], channels, (-1.0, 1.0)) for name in channels])
    for i, name in enumerate(channels):
        asymmetry = np.max(np.abs(correlation[i] - correlation[:, i]))
        if max(abs(correlation[i, i] - 1.0), asymmetry) > SYMMETRY_TOLERANCE:
            raise lines[name].error("is not symmetric with 1 on the diagonal", "Correct it, or leave correlations out")
    if np.linalg.eigvalsh(correlation)[0] < MIN_EIGENVALUE:
        fault = "the correlations contradict each other (not positive definite)"
        raise lines[channels[0]].error(fault, "Correct them, or leave correlations out")
    return correlation


# ---- terms -----------------------------------------------------------------------------------------------------------


def _ordered_term_rows(
    lines: Sequence[MatrixRow], components: tuple[str, ...], term_row_number: int, reading_unit: str
) -> list[MatrixRow]:
    """The rows of all terms in the order of `all_terms`."""
    terms = {term.name(components): term for term in all_terms(len(components))}
    # Spaces between two loads are optional.
    full_names = {_remove_spaces(name): name for name in terms}
    rows: dict[str, MatrixRow] = {}
    for line in lines:
        name = full_names.get(_remove_spaces(line.name))
        if name is None:
            raise line.error("is not a term of these components", suggest_name(line.name, tuple(terms)))
        if name in rows:
            raise line.error(f"is there twice, first in line {rows[name].number}", "Keep one of them")
        _check_unit(line, terms[name], components, reading_unit)
        rows[name] = line
    for name in terms:
        if name not in rows:
            remedy = "Write a line for each term, of zeros where no channel has it"
            raise UserError(
                f"there is no line for the term `{name}`", place=f"below line {term_row_number}", remedy=remedy
            )
    return [rows[name] for name in terms]


def _remove_spaces(text: str) -> str:
    return "".join(text.split())


def _check_unit(line: MatrixRow, term: Term, components: tuple[str, ...], reading_unit: str) -> None:
    expected = term_unit(term, components, reading_unit)
    if _remove_spaces(line.unit) != _remove_spaces(expected):
        raise unit_error(line, expected)


def _check_magnitudes(lines: Sequence[MatrixRow], matrix: CalibrationMatrix) -> None:
    """Raise UserError for a coefficient whose contribution at the calibrated range is not credible."""
    at_calibrated_range = terms_at_calibrated_range(matrix.calibrated_range)
    largest = LARGEST_COUNT if matrix.reading_unit == NUMBER else MAX_READING
    for line, coefficients, load in zip(lines, matrix.coefficients, at_calibrated_range, strict=True):
        for name, value in zip(matrix.channel_names, coefficients, strict=True):
            if abs(value) > largest / load:
                fault = f"{value:g} contributes more than {largest:g} {matrix.reading_unit} at the calibrated range"
                raise line.error(fault, "Correct the number or its unit", name)


def _check_conditioning(line: MatrixRow, matrix: CalibrationMatrix) -> None:
    """Raise UserError where the linear part does not determine the loads."""
    linear_matrix = matrix.coefficients[: len(matrix.components)].T * matrix.calibrated_range
    s = np.linalg.svd(linear_matrix / matrix.residual_sigma[:, None], compute_uv=False)
    if s[-1] * MAX_LINEAR_CONDITION <= s[0]:
        fault = "the terms of first degree do not determine the loads"
        raise line.error(fault, "Correct them, or give the channels that are missing")
