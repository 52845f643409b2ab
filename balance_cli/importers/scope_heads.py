"""Heads of oscilloscopes that state the clock of the record in two cells beside the names of the channels.

Rigol writes

    X,CH1,CH2,Start,Increment,
    Sequence,Volt,Volt,-3.500000e-03,5.000000e-06,
    0,2.4e-02,8.0e-03,

where `X` counts the samples and `Increment` is their step in seconds.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from balance_cli.importers.written_numbers import plausible_rate

START, STEP = "start", "increment"
"""Cells of the row of names whose values stand below, in the row of units."""
SAMPLE_NUMBERS = ("sequence", "no.")
"""Words in place of a unit above a column that counts the samples."""


def without_clock_cells(header: Sequence[Sequence[str]]) -> tuple[list[list[str]], float | None]:
    """The rows of a head without the cells of start and step, and the rate [Hz]; None where they state none."""
    rows = [list(row) for row in header]
    for names, values in itertools.pairwise(rows):
        places = [k for k, name in enumerate(names) if name.lower() in (START, STEP)]
        step = next((values[k] for k in places if names[k].lower() == STEP and k < len(values)), None)
        if step is None:
            continue
        try:
            rate = plausible_rate(step)[0]
        except ValueError:
            continue
        for k in reversed(places):
            del names[k], values[k : k + 1]
        return rows, rate
    return rows, None


def counts_samples(unit: str) -> bool:
    """Whether the unit of a column says that it counts the samples."""
    return unit.lower() in SAMPLE_NUMBERS
