"""How a text file of columns is laid out: encoding, separator, decimal sign, rows of names and units, first row."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass, field

from balance_cli.importers.base import TextLayout
from balance_cli.importers.clock_fractions import fraction_columns
from balance_cli.importers.column_clocks import head_of_used_columns
from balance_cli.importers.scope_heads import counts_samples, without_clock_cells
from balance_cli.importers.stated_clock import stated_rates
from balance_cli.importers.text_blocks import (
    FEWEST_BLOCK_ROWS,
    require_one_block,
    require_one_notation,
    require_one_sign,
    split_cells,
)
from balance_cli.importers.text_clock import CLOCK
from balance_cli.importers.text_names import KEY, NAME_KEYS, counts_rows, names_and_units, names_without_cells
from balance_cli.importers.time_columns import time_columns
from balance_cli.io.errors import UserError
from balance_cli.io.text_format import SEPARATORS, is_remark
from balance_cli.io.text_numbers import group_sign, is_complex, is_missing, is_number, require_clear_decimals

NUMERIC_SHARE = 0.5
"""Share of the cells of a row that must be numbers, times or empty for a row of data; a row of names has hardly any."""
TYPICAL_ROWS = 50
"""Rows whose usual number of cells is that of the table."""
FEWEST_SPARSE_ROWS = 4
"""Values at even distances from which a column counts as one of a lower rate; two gaps alike can be chance."""
NUMERIC_COLUMN_SHARE = 0.9
"""Share of the cells of a column that must be numbers for a column of numbers: a word among them (`Max`, `overload`) is
then a fault of its row, where a column of labels has hardly any number."""
COMMENTS = ("comment", "comments", "remark", "kommentar", "bemerkung")
"""Names of columns that are no channels where they are empty: LabVIEW writes one in every file."""
MOST_FOOTER_ROWS = 10
"""Rows below a table that are looked through for its end."""
MOST_COLUMNS, LEAST_SHAPE = 100, 0.1
"""A table of more columns with fewer rows for each has the channels in its rows: no logger writes it otherwise."""


@dataclass(frozen=True)
class Columns:
    """The layout that was found.

    `first_row` counts from 0. `numeric` are the columns of numbers, `clock` those of dates or times of day; others are
    text, or empty without a name. `sparse` are columns of a lower rate that share the rows of the others: the first row
    of data with a value, and the rows from one to the next. `times` are columns of times, each of those behind it,
    where there are several. `group_sign` stands between thousands. `fractions` are columns that count parts of the
    seconds of a column of times, and the seconds of one part; they are no channels. `left_out` are names without cells.
    """

    encoding: str
    separator: str
    decimal: str
    first_row: int
    names: tuple[str, ...]
    units: tuple[str, ...]
    numeric: tuple[int, ...]
    clock: tuple[int, ...]
    stated_rates: tuple[float, ...] = ()
    sparse: dict[int, tuple[int, int]] = field(default_factory=dict)
    times: tuple[int, ...] = ()
    group_sign: str = ""
    fractions: dict[int, tuple[int, float]] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()


def find_columns(text: str, is_whole: bool, encoding: str, layout: TextLayout) -> Columns:
    """Find the layout from the beginning of a file; what `layout` states is taken as given.

    Raises UserError where no columns of numbers are found.
    """
    lines = text.splitlines() if is_whole else text.splitlines()[:-1]
    while is_whole and lines and is_remark(lines[-1]):
        lines.pop()
    separator, decimal, first = _choose_separators(lines, layout)
    rows = [split_cells(line, separator) for line in lines]
    if layout.first_row is None:
        first += _is_row_of_numbers_as_names(rows, decimal) if first == 0 else _settings(rows, first, decimal)
        require_one_block(rows[:first], decimal)
        require_one_notation(lines, first, separator, decimal)
        _require_plausible_shape(rows, first, separator, is_whole)
    header, rate = without_clock_cells(rows[:first])
    names, units = names_and_units(header, rows[first:], layout)
    numeric, clock = _column_kinds(rows[first:], decimal, names)
    numeric, names = _without_sample_numbers(numeric, names, units)
    heads = list(zip(names, units, strict=True))
    fractions = fraction_columns(rows[first:], clock, heads)
    numeric = tuple(sorted(set(numeric).difference(place for place, _ in fractions.values())))
    if layout.decimal is None:
        _require_clear_signs(rows[first:], first, decimal, {column: names[column] for column in numeric})
    sparse = _sparse_columns(rows[first:], numeric)
    dense = [column for column in numeric if column not in sparse]
    times = time_columns(rows[first:], decimal, dense, heads)
    head = head_of_used_columns(lines[:first], rows, separator, has_times=len(times) > 1)
    return Columns(
        encoding=encoding,
        separator=separator,
        decimal=decimal,
        first_row=first,
        names=names,
        units=units,
        numeric=numeric,
        clock=clock,
        stated_rates=(rate,) if rate else stated_rates(head, separator),
        sparse=sparse,
        times=times,
        group_sign=_sign_between_thousands(rows[first:], numeric, decimal),
        fractions=fractions,
        left_out=names_without_cells(header, rows[first:]),
    )


def _require_clear_signs(rows: Sequence[Sequence[str]], first: int, decimal: str, columns: dict[int, str]) -> None:
    """Raise UserError where the decimal sign of a column changes, or can be one between thousands."""
    require_one_sign(rows, first, decimal, list(columns.items()))
    for column, name in columns.items():
        require_clear_decimals(_cells(rows, column), decimal, name)


def _sign_between_thousands(rows: Sequence[Sequence[str]], numeric: Sequence[int], decimal: str) -> str:
    return next((sign for column in numeric if (sign := group_sign(_cells(rows, column), decimal))), "")


def _cells(rows: Sequence[Sequence[str]], column: int) -> list[str]:
    return [row[column] for row in rows if len(row) > column]


def _choose_separators(lines: Sequence[str], layout: TextLayout) -> tuple[str, str, int]:
    """Separator, decimal sign and first row of numbers, as they are stated or as they give the best table."""
    found = _best_table(lines, layout)
    if found is None:
        _require_data_to_the_end(lines, layout)
        raise UserError("has no columns of numbers", remedy="State `separator`, `decimal` and `first_row` under `text`")
    return found


def _best_table(lines: Sequence[str], layout: TextLayout) -> tuple[str, str, int] | None:
    """Separator, decimal sign and first row of the best table; None where there is none."""
    stated = re.match(r"^sep=(.)$", lines[0]) if lines else None
    separator = layout.separator or (stated[1] if stated else None)
    choices = [
        _lay_out(lines, separator, decimal, layout)
        for separator in ([separator] if separator else SEPARATORS)
        for decimal in ([layout.decimal] if layout.decimal else [".", ","])
        # In quotes a number may have the separator as its decimal sign.
        if separator != decimal or any('"' in line for line in lines[-1:])
    ]
    best = max((choice for choice in choices if choice), key=lambda choice: choice[0], default=None)
    return None if best is None else best[1:]


def _require_data_to_the_end(lines: Sequence[str], layout: TextLayout) -> None:
    """Raise UserError, with the row, where a table is followed by other rows: a footer, statistics of the columns."""
    filled = [k for k, line in enumerate(lines) if line.strip()]
    for last, below in itertools.pairwise(filled[: -2 - MOST_FOOTER_ROWS : -1]):
        if _best_table(lines[: below + 1], layout) is not None:
            fault = f"`{lines[last].strip()[:40]}` is no row of numbers like those above"
            raise UserError(fault, place=f"row {last + 1}", remedy="Remove what stands below the data")


def _without_sample_numbers(
    numeric: Sequence[int], names: Sequence[str], units: Sequence[str]
) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Columns of numbers and names of all, without those that count the samples."""
    kept = tuple(column for column in numeric if not counts_samples(units[column]))
    return kept, tuple("" if counts_samples(unit) else name for name, unit in zip(names, units, strict=True))


def _is_row_of_numbers_as_names(rows: Sequence[Sequence[str]], decimal: str) -> bool:
    """Whether the first row has numbers for names: words or 0, 1, 2 ... above columns of other numbers."""
    if len(rows) < 3:
        return False
    cells = [cell for cell in rows[0] if not is_missing(cell)]
    words = [cell for cell in cells if not is_number(cell, decimal) and not CLOCK.match(cell)]
    are_whole = all(cell.isdigit() for cell in cells if cell not in words)
    has_fractions = any(decimal in cell for row in rows[1:] for cell in row if is_number(cell, decimal))
    has_words_below = any(word and not is_number(word, decimal) for row in rows[1:] for word in row)
    return are_whole and has_fractions and (counts_rows(cells) if not words else not has_words_below)


def _settings(rows: Sequence[Sequence[str]], first: int, decimal: str) -> int:
    """Rows of settings with numbers below one of names: `Name`, `Rate`, `Range` above a column of numbers."""
    above = rows[first - 1]
    if not above or above[0].lower() not in NAME_KEYS or len(above) != len(rows[first]):
        return 0
    begins = [row[0] for row in rows[first:] if row]
    count = next((k for k, cell in enumerate(begins) if is_number(cell, decimal)), 0)
    return count if all(is_number(cell, decimal) for cell in begins[count:]) else 0


def _require_plausible_shape(rows: Sequence[Sequence[str]], first: int, separator: str, is_whole: bool) -> None:
    """Raise UserError where the comma is separator and decimal sign, or a row is a channel."""
    width, count = len(rows[first]), len(rows) - first
    header = next((row for row in reversed(rows[:first]) if any(row)), [])
    if separator == "," and 2 * len(header) == width and all(cell.lstrip("+-").isdigit() for cell in rows[first]):
        fault = f"has rows of {width} whole numbers below {len(header)} names: the comma is separator and decimal sign"
        raise UserError(fault, remedy="Export with semicolons or tabs between the columns")
    if is_whole and width > MOST_COLUMNS and count < LEAST_SHAPE * width:
        fault = f"has {count} rows of {width} cells: a row for each channel, where a column was expected"
        raise UserError(fault, remedy="Export it with a column for each channel")


def _sparse_columns(rows: Sequence[Sequence[str]], numeric: Sequence[int]) -> dict[int, tuple[int, int]]:
    """Columns with a value in every k-th row only, and none in all others."""
    sparse = {}
    for column in numeric:
        filled = [k for k, row in enumerate(rows) if len(row) > column and not is_missing(row[column])]
        steps = {after - before for before, after in itertools.pairwise(filled)}
        step = steps.pop() if len(steps) == 1 and len(filled) >= FEWEST_SPARSE_ROWS else 1
        if step > 1 and filled[0] < step and filled[-1] + step >= len(rows):
            sparse[column] = (filled[0], step)
    return sparse


Score = tuple[int, int, float, int, int, int]


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
            if len(rows[k]) != width or not (_is_data(rows[k], decimal) or _is_gap(rows, k, decimal)):
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
    grouped = sum(
        bool(group_sign([row[column] for row in rows[first:] if len(row) > column], decimal)) for column in numeric
    )
    # Integers are numbers with either decimal sign, and the point is then the usual one.
    return (count, int(matches), share, -grouped, width, int(decimal == ".")), separator, decimal, first


def _begins_wider_rows(rows: Sequence[Sequence[str]], last: int, width: int, decimal: str) -> bool:
    """Whether rows up to `last` are data with more cells: columns of a lower rate end above, without separators."""
    above = rows[max(last + 1 - FEWEST_BLOCK_ROWS, 0) : last + 1]
    same = {len(row) for row in above} == {len(rows[last])}
    return len(rows[last]) > width and same and all(_is_data(row, decimal) for row in above)


def _is_data(row: Sequence[str], decimal: str) -> bool:
    if row and KEY.match(row[0]):
        return False
    values = [cell for cell in row if not is_missing(cell) and not is_complex(cell)]
    numbers = sum(is_number(cell, decimal) for cell in values)
    clocks = sum(bool(CLOCK.match(cell)) for cell in values)
    return numbers > 0 and numbers + clocks >= NUMERIC_SHARE * len(values)


def _is_gap(rows: Sequence[Sequence[str]], place: int, decimal: str) -> bool:
    """Whether a row has words for missing values alone, below a row of data or another one like it."""
    cells = rows[place]
    if not any(cells) or not all(is_missing(cell) for cell in cells):
        return False
    above = next((k for k in range(place - 1, -1, -1) if any(cell and not is_missing(cell) for cell in rows[k])), None)
    return above is not None and len(rows[above]) == len(cells) and _is_data(rows[above], decimal)


def _column_kinds(
    rows: Sequence[Sequence[str]], decimal: str, names: Sequence[str]
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Columns of numbers, and of clock times; one without values and name is neither."""
    numeric, clock = [], []
    for column, name in enumerate(names):
        cells = [row[column] for row in rows if len(row) > column and not is_missing(row[column])]
        numbers = sum(is_number(cell, decimal) for cell in cells)
        nameless = ("", f"column {column + 1}", *COMMENTS)
        if numbers >= NUMERIC_COLUMN_SHARE * len(cells) and (cells or name.lower() not in nameless):
            numeric.append(column)
        elif cells and all(CLOCK.match(cell) for cell in cells):
            clock.append(column)
    return tuple(numeric), tuple(clock)
