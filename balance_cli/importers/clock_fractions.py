"""Columns that count the parts of a second beside a column of whole seconds, as loggers of Graphtec write them."""

from __future__ import annotations

import re
from collections.abc import Sequence

from balance_cli.importers.text_clock import CLOCK

_PARTS = re.compile(r"^(?P<prefix>[mun\u00b5\u03bc]|milli|micro|nano)_?(?:s|secs?|seconds?)$", re.IGNORECASE)
_SECONDS = {"m": 1e-3, "milli": 1e-3, "n": 1e-9, "nano": 1e-9}
"""By the prefix; all others are microseconds."""

Rows = Sequence[Sequence[str]]


def fraction_columns(
    rows: Rows, clock: Sequence[int], heads: Sequence[tuple[str, str]]
) -> dict[int, tuple[int, float]]:
    """Return the column behind each column of times that counts parts of its seconds, and the seconds of one part.

    Name or unit must say so, the times must be whole seconds, and all parts less than one. `heads` are name and unit
    of each column.
    """
    found = {}
    for column in clock:
        behind = column + 1
        seconds = _seconds(heads[behind]) if behind < len(heads) else None
        if seconds is not None and all(_are_parts(row, column, seconds) for row in rows if len(row) > behind):
            found[column] = (behind, seconds)
    return found


def _seconds(head: tuple[str, str]) -> float | None:
    """Seconds of one part by the unit of a column or its name; None where neither names parts of a second."""
    match = _PARTS.match(head[1]) or _PARTS.match(head[0])
    return None if match is None else _SECONDS.get(match["prefix"].lower(), 1e-6)


def _are_parts(row: Sequence[str], column: int, seconds: float) -> bool:
    time, part = CLOCK.match(row[column]), row[column + 1]
    return time is not None and not time["f"] and part.isdigit() and int(part) * seconds < 1.0
