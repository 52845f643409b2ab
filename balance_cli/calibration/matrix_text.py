"""A calibration matrix as text: CSV for spreadsheets and `read_matrix` (`balance-matrix/1`), or aligned columns.

Every line has a name, a unit and values: first the components and their calibrated ranges, then the channels, then one
line for each term with one column for each channel.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence

import numpy as np

from balance_cli.calibration.matrix import CalibrationMatrix, term_unit
from balance_cli.calibration.terms import all_terms
from balance_cli.campaign.rig.components import UNIT_OF
from balance_cli.io.formula_cells import text_cell

FORMAT = "balance-matrix/1"
READABLE_FORMAT = f"{FORMAT} for reading"
NOTES = (
    "A channel reads its zero plus the sum over the terms of coefficient times term, loads in N and N m.",
    "Axes and signs are those of the rig; moments count about its hub.",
)

NOTE, RIG, COMPONENT, UNIT = "note", "rig", "component", "unit"
FULL_RANGE, SMALLEST, LARGEST = "full range", "smallest load", "largest load"
CHANNEL, ZERO, RESIDUAL, DOF = "channel", "zero", "residual standard deviation", "degrees of freedom"
CORRELATION = "correlation with "
TERM = "term"

NamedValues = tuple[str, str, Sequence[str | float]]


def matrix_csv(matrix: CalibrationMatrix) -> str:
    """Format the matrix as CSV, with all digits of every number."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([FORMAT])
    for name, unit, values in _named_values(matrix):
        writer.writerow(
            [name, unit, *(text_cell(value) if isinstance(value, str) else repr(value) for value in values)]
        )
    return out.getvalue()


def matrix_text(matrix: CalibrationMatrix) -> str:
    """Format the matrix in aligned columns, with seven digits."""
    lines = list(_named_values(matrix))
    notes = [values[0] for name, _, values in lines if name == NOTE]
    cells = [[_printable(name), unit, *map(_format_value, values)] for name, unit, values in lines if name != NOTE]
    width = [max(len(line[i]) for line in cells if i < len(line)) for i in range(max(map(len, cells)))]
    left = [width[0], width[1]]
    aligned = ("  ".join([*map(str.ljust, line, left), *map(str.rjust, line[2:], width[2:])]) for line in cells)
    return "\n".join([READABLE_FORMAT, *map(str, notes), "", *(line.rstrip() for line in aligned), ""])


def _format_value(value: str | float) -> str:
    return _printable(value) if isinstance(value, str) else f"{value:.7g}"


def _printable(name: str) -> str:
    """The name with line breaks and other control characters written as escapes, so that columns stay aligned."""
    return "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in name)


def _named_values(matrix: CalibrationMatrix) -> Iterator[NamedValues]:
    """Name, unit and values of each line, in the order of the file."""
    for note in NOTES:
        yield NOTE, "", (note,)
    if matrix.rig:
        yield RIG, "", (matrix.rig,)
    yield COMPONENT, "", matrix.components
    yield UNIT, "", tuple(UNIT_OF[name] for name in matrix.components)
    for name, loads in (
        (FULL_RANGE, matrix.calibrated_range),
        (SMALLEST, matrix.smallest_load),
        (LARGEST, matrix.largest_load),
    ):
        yield name, "", loads.tolist()
    yield CHANNEL, "", matrix.channel_names
    yield ZERO, matrix.reading_unit, matrix.zeros.tolist()
    yield RESIDUAL, matrix.reading_unit, matrix.residual_sigma.tolist()
    yield DOF, "", matrix.dof.tolist()
    if np.any(matrix.correlation != np.eye(len(matrix.channel_names))):
        for name, row in zip(matrix.channel_names, matrix.correlation.tolist(), strict=True):
            yield CORRELATION + name, "", row
    yield TERM, UNIT, matrix.channel_names
    for term, coefficients in zip(all_terms(len(matrix.components)), matrix.coefficients.tolist(), strict=True):
        yield term.name(matrix.components), term_unit(term, matrix.components, matrix.reading_unit), coefficients
