"""Point tables of one load each, as a file for each weight or pose: together they are one load series.

A table has a zero of its own, and the only load of such a table would be all zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from balance_cli.campaign.recording.load_table import LoadTable

FEWEST_TABLES = 3
"""Two loads are a zero and a slope, with nothing left to test them."""
LARGEST_CHANGE = 3e-3
"""Of the largest load of all tables, within which the rows of a table state one load: that of consecutive rows."""
COMMON_SERIES = "1"
"""Label of the load series that all rows are."""


def joined_single_loads(tables: Sequence[LoadTable]) -> LoadTable | None:
    """All tables as one, in the given order, with one zero in common; None where one of them is a series by itself.

    None, too, where their rows have labels of series or runs, or the tables differ in their columns.
    """
    if len(tables) < FEWEST_TABLES or len({_columns(table) for table in tables}) > 1:
        return None
    first = tables[0]
    if first.hub_loads is None or {"series", "run"} & set(first.labels):
        return None
    loads = [table.hub_loads for table in tables if table.hub_loads is not None]
    largest = np.max([np.abs(each).max(axis=0) for each in loads], axis=0)
    if any(np.any(np.ptp(each, axis=0) > LARGEST_CHANGE * largest) for each in loads):
        return None
    n = sum(map(len, loads))
    labels = {key: tuple(text for table in tables for text in table.labels[key]) for key in first.labels}
    labels |= {"series": (COMMON_SERIES,) * n, "run": (f"{first.path.stem}..{tables[-1].path.stem}",) * n}
    return replace(
        first,
        lines=tuple(line for table in tables for line in table.lines),
        channels=np.vstack([table.channels for table in tables]),
        hub_loads=np.vstack(loads),
        labels=labels,
        temperature=None if first.temperature is None else np.concatenate([t.temperature for t in tables]),
        attitude=None if first.attitude is None else np.vstack([t.attitude for t in tables if t.attitude is not None]),
    )


def _columns(table: LoadTable) -> tuple[object, ...]:
    """What tables must have in common to be one."""
    has = (table.hub_loads is None, table.temperature is None, table.attitude is None)
    return table.channel_names, tuple(table.labels), *has
