"""Steps and starts that the head of a text file states for each of its columns."""

from __future__ import annotations

from collections.abc import Sequence

from balance_cli.io.errors import UserError
from balance_cli.io.text_numbers import is_missing

COLUMN_CLOCKS = ("delta_x", "dx", "x0")
"""First cells of rows with the step or the start of each column, in lower case without a colon."""


def head_of_used_columns(
    lines: Sequence[str], rows: Sequence[Sequence[str]], separator: str, has_times: bool
) -> list[str]:
    """The lines of a head, without the clocks of columns that have no value in the rows behind it.

    LabVIEW states a step of 1 s for a channel without samples, beside those of the others. `rows`: cells of the head
    and of the data. Raises UserError where the columns have different clocks, and no columns of times (`has_times`).
    """
    data = rows[len(lines) :]
    filled = {column for row in data for column, cell in enumerate(row) if not is_missing(cell)}
    width = max(map(len, data), default=0)
    head = list(lines)
    for place, row in enumerate(rows[: len(lines)]):
        if not row or row[0].lower().rstrip(":") not in COLUMN_CLOCKS:
            continue
        cells = [cell if column in filled else "" for column, cell in enumerate(row) if column > 0]
        if not any(cells) or any(row[width:]):  # the clocks stand beside their columns, not above them
            cells = list(row[1:])
        if not has_times:
            _require_one_clock(row[0], cells)
        head[place] = separator.join([row[0], *cells])
    return head


def _require_one_clock(key: str, cells: Sequence[str]) -> None:
    stated = sorted({cell for cell in cells if cell})
    if len(stated) > 1:
        fault = f"has columns with `{key}` of {' and '.join(stated[:3])}, and no times for each of them"
        raise UserError(fault, remedy="Export a column of times for each rate, or a file for each rate")
