"""Steps and starts that the head of a text file states for each of its columns."""

from __future__ import annotations

from collections.abc import Sequence

from balance_cli.io.errors import UserError
from balance_cli.io.text_numbers import is_missing

COLUMN_CLOCKS = ("delta_x", "dx", "x0")
"""First cells of rows with the step or the start of each column, in lower case without a colon."""


def without_empty_columns(
    lines: Sequence[str], header: Sequence[Sequence[str]], rows: Sequence[Sequence[str]], separator: str
) -> tuple[list[str], list[list[str]]]:
    """The lines of a head and their cells, without the clocks of columns that have no value in the rows of data.

    LabVIEW states a step of 1 s for a channel without samples, beside those of the others.
    """
    filled = {column for row in rows for column, cell in enumerate(row) if not is_missing(cell)}
    kept_lines, kept = list(lines), [list(row) for row in header]
    for place, row in enumerate(kept):
        if not _states_clocks(row) or not filled.intersection(range(1, len(row))):
            continue
        row[1:] = [cell if column in filled else "" for column, cell in enumerate(row[1:], start=1)]
        kept_lines[place] = separator.join(row)
    return kept_lines, kept


def require_one_clock(header: Sequence[Sequence[str]]) -> None:
    """Raise UserError where the head states different steps or starts of columns without times of their own."""
    for row in header:
        stated = sorted({cell for cell in row[1:] if cell})
        if _states_clocks(row) and len(stated) > 1:
            fault = f"has columns with `{row[0]}` of {' and '.join(stated[:3])}, and no times for each of them"
            remedy = "Export a column of times for each rate, or a file for each rate"
            raise UserError(fault, remedy=remedy)


def _states_clocks(row: Sequence[str]) -> bool:
    return bool(row) and row[0].lower().rstrip(":") in COLUMN_CLOCKS
