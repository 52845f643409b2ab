"""Columns of times in a text with several rates: each belongs to the columns behind it."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence

import numpy as np

from balance_cli.importers.base import ChannelGroup
from balance_cli.io.units import TIME, can_be_unit_of

TIME_NAME = re.compile(r"^(?:.*/)?(time|zeit|temps|timestamp|ts|x[ _]value|t)([\W_\d].*)?$", re.IGNORECASE)
"""A group may stand before the name, as in `Untitled/Time`."""
LARGEST_UNEVENNESS = 0.6
"""Of the mean step: rounded times scatter by half of one."""
FEWEST_TIMES = 3
"""Times whose two steps can be compared."""


def time_columns(
    rows: Sequence[Sequence[str]], decimal: str, numeric: Sequence[int], heads: Sequence[tuple[str, str]]
) -> tuple[int, ...]:
    """Return the columns of times that columns of values follow; none where there is but one.

    A column of times has a name or a unit that says so, and values that increase evenly as far as there are any.
    `heads` are name and unit of each column.
    """
    time_like = [k for k in numeric if is_time_column(*heads[k]) and _increases_evenly(_values(rows, k, decimal))]
    last = max(numeric, default=0)
    time_like = [k for k in time_like if k < last and k + 1 not in time_like]
    return tuple(time_like) if len(time_like) > 1 else ()


def is_time_column(name: str, unit: str) -> bool:
    """Return whether a column is one of times by its unit or, without one, its name."""
    if unit:
        return can_be_unit_of(unit, TIME)
    return bool(TIME_NAME.match(name))


def _values(rows: Sequence[Sequence[str]], column: int, decimal: str) -> list[float]:
    """Return the numbers of a column down to its first empty cell."""
    values: list[float] = []
    for row in rows:
        cell = row[column] if len(row) > column else ""
        try:
            values.append(float(cell.replace(decimal, ".")))
        except ValueError:
            break
    return values


def _increases_evenly(values: Sequence[float]) -> bool:
    steps = np.diff(values)
    if len(values) < FEWEST_TIMES or not np.all(steps > 0):
        return False
    return bool(np.abs(steps - steps.mean()).max() <= 2.0 * LARGEST_UNEVENNESS * steps.mean())


def parts_by_time(used: Sequence[int], times: Sequence[int]) -> list[list[int]]:
    """Return the columns in parts, each from its column of times on; the first has those before it, too."""
    starts = [0, *times[1:], max(used, default=0) + 1]
    return [[k for k in used if begin <= k < end] for begin, end in itertools.pairwise(starts)]


def filled_rows(group: ChannelGroup, column: int) -> int:
    """Return the number of rows down to the last value of a column that ends before the others, found by bisection."""
    filled, empty = 0, group.samples
    if np.isfinite(group.read([column], empty - 1, empty)[0, 0]):
        return empty
    while empty - filled > 1:
        middle = (filled + empty) // 2
        is_filled = np.isfinite(group.read([column], middle, middle + 1)[0, 0])
        filled, empty = (middle, empty) if is_filled else (filled, middle)
    return empty
