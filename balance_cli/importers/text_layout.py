"""How a text file of columns is laid out: encoding, separator, decimal sign, rows of names and units, first row."""

from __future__ import annotations

import csv
import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass, field

from balance_cli.importers.base import TextLayout
from balance_cli.importers.time_columns import time_columns
from balance_cli.importers.written_numbers import plausible_rate
from balance_cli.io.errors import UserError
from balance_cli.io.text_cells import SEPARATORS, is_remark
from balance_cli.io.units import is_unit, split_unit

MISSING_WORDS = ("", "nan", "na", "n/a", "#n/a", "null", "none", "-", "--", "---", "1.#ind", "-1.#ind", "1.#qnan")
"""Cells without a value, in lower case."""
NUMERIC_SHARE = 0.5
"""Share of the cells of a row that must be numbers, times or empty for a row of data; a row of names has hardly any."""
TYPICAL_ROWS = 50
"""Rows whose usual number of cells is that of the table."""
FEWEST_BLOCK_ROWS = 5
"""Rows of numbers above the names of a table that are a table of their own; heads have fewer, with words."""
FEWEST_SPARSE_ROWS = 4
"""Values at even distances from which a column counts as one of a lower rate; two gaps alike can be chance."""
NUMERIC_COLUMN_SHARE = 0.9
"""Share of the cells of a column that must be numbers for a column of numbers: a word among them (`Max`, `overload`) is
then a fault of its row, where a column of labels has hardly any number."""
UNIT_SHARE = 0.5
"""Share of the cells of a row that must be units for a row of units; names such as `N` or `Mz` are rare."""

_NUMBER = {
    ".": re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)([eEdD][-+]?\d+)?$|^[-+]?inf(inity)?$", re.IGNORECASE),
    ",": re.compile(r"^[-+]?(\d+,?\d*|,\d+)([eEdD][-+]?\d+)?$|^[-+]?inf(inity)?$", re.IGNORECASE),
}
_KEY = re.compile(r"^[A-Za-z][\w -]*:$")
"""The first cell of a row of a head that says what the others are, as imc writes it: `Name:`, `Unit:`, `dx:`."""
_CLOCK = re.compile(
    r"^(\d{1,4}[-./]\d{1,2}[-./]\d{1,4}[ T]?)?\d{1,2}:\d{2}(:\d{2}([.,]\d+)?)?( ?[AP]M|Z|[+-]\d\d:?\d\d)?$",
    re.IGNORECASE,
)
_RATE = re.compile(
    r"(?:sampl\w*[ _-]*(?:rate|freq\w*)|abtastrate|messrate|\bfs)\b[^\w\n]*(?:(k?hz)\b[^\w\n]*)?"
    r"([0-9]+(?:[.,][0-9]+)?)\s*(k?hz)?",
    re.IGNORECASE,
)
"""Between the word and its number only signs and a unit: `default sample rate <tab> DMS_1` states none."""
_STEP = re.compile(
    r"^\W*(?:delta[ _]?[xt]|d[tx]|time[ _]step|(?:sampl\w*|time)[ _]interval|abtastintervall)\b[^\w\n]*(?:s\b[^\w\n]*)?"
    r"([0-9]*[.,]?[0-9]+(?:e[-+]?[0-9]+)?)(?=[\s;]|$)(?![ \t]*[muµ]s\b)",
    re.IGNORECASE | re.MULTILINE,
)
"""A time step [s], as LabVIEW (`Delta_X`), catman (`DT = `) and imc (`dx:`) state it."""


@dataclass(frozen=True)
class Columns:
    """The layout that was found.

    `first_row` counts from 0. `numeric` are the columns of numbers, `clock` those of dates or times of day; others are
    text, or empty without a name. `sparse` are columns of a lower rate that share the rows of the others: the first row
    of data with a value, and the rows from one to the next. `times` are columns of times, each of those behind it,
    where there are several.
    """

    encoding: str
    separator: str
    decimal: str
    first_row: int
    names: tuple[str, ...]
    units: tuple[str, ...]
    numeric: tuple[int, ...]
    clock: tuple[int, ...]
    stated_rate: float | None = None
    sparse: dict[int, tuple[int, int]] = field(default_factory=dict)
    times: tuple[int, ...] = ()


def find_columns(text: str, is_whole: bool, encoding: str, layout: TextLayout) -> Columns:
    """Find the layout from the beginning of a file; what `layout` states is taken as given.

    Raises UserError where no columns of numbers are found.
    """
    lines = text.splitlines() if is_whole else text.splitlines()[:-1]
    while is_whole and lines and is_remark(lines[-1]):
        lines.pop()
    stated = re.match(r"^sep=(.)$", lines[0]) if lines else None
    separators = [layout.separator or stated[1]] if layout.separator or stated else list(SEPARATORS)  # type: ignore[index]
    decimals = [layout.decimal] if layout.decimal else [".", ","]
    choices = [
        _lay_out(lines, separator, decimal, layout)
        for separator in separators
        for decimal in decimals
        if separator != decimal
    ]
    best = max((choice for choice in choices if choice), key=lambda choice: choice[0], default=None)
    if best is None:
        raise UserError("has no columns of numbers", remedy="State `separator`, `decimal` and `first_row` under `text`")
    _, separator, decimal, first = best
    rows = [split_cells(line, separator) for line in lines]
    if layout.first_row is None:
        _require_one_block(rows[:first], decimal)
    names, units = _names_and_units(rows[:first], rows[first:], layout)
    numeric, clock = _column_kinds(rows[first:], decimal, names)
    rate = _stated_rate(lines[:first])
    sparse = _sparse_columns(rows[first:], numeric)
    dense = [column for column in numeric if column not in sparse]
    times = time_columns(rows[first:], decimal, dense, list(zip(names, units, strict=True)))
    return Columns(encoding, separator, decimal, first, names, units, numeric, clock, rate, sparse, times)


def _require_one_block(header: Sequence[Sequence[str]], decimal: str) -> None:
    """Raise UserError where rows of numbers stand above the names: the table found is not the first one of the file."""
    run = 0
    for row, cells in enumerate(header):
        values = [cell for cell in cells if cell.lower() not in MISSING_WORDS]
        run = run + 1 if len(values) > 1 and all(_NUMBER[decimal].match(cell) for cell in values) else 0
        if run == FEWEST_BLOCK_ROWS:
            fault = f"has several blocks of rows, one from row {row + 2 - run} and one behind row {len(header)}"
            remedy = "Save each block as a file of its own, or state `first_row` of the last one under `text`"
            raise UserError(fault, remedy=remedy)


def _sparse_columns(rows: Sequence[Sequence[str]], numeric: Sequence[int]) -> dict[int, tuple[int, int]]:
    """Columns with a value in every k-th row only, and none in all others."""
    sparse = {}
    for column in numeric:
        filled = [k for k, row in enumerate(rows) if len(row) > column and row[column].lower() not in MISSING_WORDS]
        steps = {after - before for before, after in itertools.pairwise(filled)}
        step = steps.pop() if len(steps) == 1 and len(filled) >= FEWEST_SPARSE_ROWS else 1
        if step > 1 and filled[0] < step and filled[-1] + step >= len(rows):
            sparse[column] = (filled[0], step)
    return sparse


def split_cells(line: str, separator: str) -> list[str]:
    """The cells of a row, without quotes and outer spaces."""
    if separator == " ":
        return line.replace('"', "").split()
    if '"' in line:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]
    return [cell.strip() for cell in line.split(separator)]


Score = tuple[int, int, float, int, int]


def _lay_out(
    lines: Sequence[str], separator: str, decimal: str, layout: TextLayout
) -> tuple[Score, str, str, int] | None:
    """Score, separator, decimal sign and first row of data of one choice; None where it has no rows of numbers."""
    rows = [split_cells(line, separator) for line in lines]
    filled = [k for k, row in enumerate(rows) if any(row)]
    if not filled:
        return None
    lengths = [len(rows[k]) for k in filled[-TYPICAL_ROWS:]]
    width = max(set(lengths), key=lambda length: (lengths.count(length), length))
    if layout.first_row is not None:
        first = layout.first_row - 1
    else:
        first = filled[-1] + 1
        ends = filled[:-1] if len(filled) > 1 and len(rows[filled[-1]]) < width else filled  # the last one may be cut
        for k in reversed(ends):
            if _begins_wider_rows(rows, k, width, decimal):
                width = len(rows[k])
            if len(rows[k]) != width or not _is_data(rows[k], decimal):
                break
            first = k
    count = sum(1 for k in filled if k >= first)
    numeric, clock = _column_kinds(rows[first:], decimal, ("",) * width)
    if not count or not numeric:
        return None
    used = sum(any(len(row) > column and row[column] for row in rows[first:]) for column in range(width))
    share = (len(numeric) + len(clock)) / used
    header = next((rows[k] for k in reversed(filled) if k < first), None)
    has_empty_end = all(len(row) < width or not row[-1] for row in rows[first:])
    matches = header is None or len(header) in (width, width - has_empty_end)
    # Integers are numbers with either decimal sign, and the point is then the usual one.
    return (count, int(matches), share, width, int(decimal == ".")), separator, decimal, first


def _begins_wider_rows(rows: Sequence[Sequence[str]], last: int, width: int, decimal: str) -> bool:
    """Whether rows up to `last` are data with more cells: columns of a lower rate end above, without separators."""
    above = rows[max(last + 1 - FEWEST_BLOCK_ROWS, 0) : last + 1]
    same = {len(row) for row in above} == {len(rows[last])}
    return len(rows[last]) > width and same and all(_is_data(row, decimal) for row in above)


def _is_data(row: Sequence[str], decimal: str) -> bool:
    if row and _KEY.match(row[0]):
        return False
    values = [cell for cell in row if cell.lower() not in MISSING_WORDS]
    numbers = sum(bool(_NUMBER[decimal].match(cell)) for cell in values)
    clocks = sum(bool(_CLOCK.match(cell)) for cell in values)
    return numbers > 0 and numbers + clocks >= NUMERIC_SHARE * len(values)


def _column_kinds(
    rows: Sequence[Sequence[str]], decimal: str, names: Sequence[str]
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Columns of numbers, and of clock times; one without values and name is neither."""
    numeric, clock = [], []
    for column, name in enumerate(names):
        cells = [row[column] for row in rows if len(row) > column and row[column].lower() not in MISSING_WORDS]
        numbers = sum(bool(_NUMBER[decimal].match(cell)) for cell in cells)
        if numbers >= NUMERIC_COLUMN_SHARE * len(cells) and (cells or name):
            numeric.append(column)
        elif cells and all(_CLOCK.match(cell) for cell in cells):
            clock.append(column)
    return tuple(numeric), tuple(clock)


def _names_and_units(
    header: Sequence[Sequence[str]], data: Sequence[Sequence[str]], layout: TextLayout
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of the columns from the rows above the data, `column 1` and so on where there are none."""
    width = len(data[0])
    candidates = [k for k, row in enumerate(header) if any(row) and abs(len(row) - width) <= 1]
    keys = {header[k][0].rstrip(":").lower(): k for k in candidates if _KEY.match(header[k][0])}
    if "name" in keys and layout.name_row is None:
        return _keyed_names(header, keys, width)
    unit_row = layout.unit_row - 1 if layout.unit_row else None
    if unit_row is None and layout.name_row is None and len(candidates) > 1 and _are_units(header[candidates[-1]]):
        unit_row = candidates[-1]
    rest = [k for k in candidates if k != unit_row]
    name_row = layout.name_row - 1 if layout.name_row else (rest[-1] if rest else None)
    names = _padded(header, name_row, width)
    units = _padded(header, unit_row, width)
    pairs = [split_unit(name.lstrip("#").strip()) for name in names]
    has_names = any(names)
    plain = tuple(name if has_names else f"column {k + 1}" for k, (name, _) in enumerate(pairs))
    from_names = [unit or "" for _, unit in pairs]
    return plain, tuple(_strip_unit(unit) or own for unit, own in zip(units, from_names, strict=True))


def _keyed_names(
    header: Sequence[Sequence[str]], keys: dict[str, int], width: int
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of a head with a key in the first cell of each row, above a column of its own or none."""
    unit_row = next((keys[key] for key in ("unit", "einheit", "y-unit") if key in keys), None)
    rows = [["", *row[1:]] if len(row) <= width else row[1:] for row in header]
    names, units = _padded(rows, keys["name"], width), _padded(rows, unit_row, width)
    return tuple(names), tuple(_strip_unit(unit) for unit in units)


def _padded(rows: Sequence[Sequence[str]], row: int | None, width: int) -> list[str]:
    if row is None or not 0 <= row < len(rows):
        return [""] * width
    cells = list(rows[row])[:width]
    return cells + [""] * (width - len(cells))


def _strip_unit(text: str) -> str:
    return text.strip().strip("[]()").strip()


def _are_units(row: Sequence[str]) -> bool:
    cells = [_strip_unit(cell.lstrip("#")) for cell in row if cell]
    return bool(cells) and sum(is_unit(cell) for cell in cells) > UNIT_SHARE * len(cells)


def _stated_rate(header: Sequence[str]) -> float | None:
    """A sample rate [Hz] that the header states, itself or by its time step, for a sketch."""
    text = "\n".join(header)
    if rate := _RATE.search(text):
        return float(rate[2].replace(",", ".")) * (1000.0 if (rate[1] or rate[3] or "").lower() == "khz" else 1.0)
    step = _STEP.search(text)
    try:
        return plausible_rate(step[1].replace(",", "."))[0] if step else None
    except ValueError:
        return None
