"""The outermost distinct values of a channel, and how often each occurs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

EXTREME_VALUES = 8
"""Distinct values counted at either end of the range of a channel; the comparison below is made for eight."""
OUTER_SAMPLES = 128
"""Records of more than four times as many samples have their distinct values sought among the outermost samples first;
twice as many, evenly spaced, tell where these begin."""
OUTER_RANK = 2
"""Rank among these few, from either end, of the bound: a ninetieth of the samples lies beyond it, and once in several
thousand records fewer than eight of 24000."""


def outer_values(values: Array) -> tuple[Array, Integers]:
    """The distinct values at both ends of the range, EXTREME_VALUES or more of each, and how often each occurs.

    A sort of all samples would take twenty times as long. The bounds of both ends come from every so many samples.
    """
    if len(values) > 4 * OUTER_SAMPLES:
        few = np.sort(values[:: len(values) // (2 * OUTER_SAMPLES)])
        low, high = few[OUTER_RANK], few[-1 - OUTER_RANK]
        ends = [_distinct_values(part) for part in (values[values <= low], values[values >= high])]
        if low < high and all(len(distinct) >= EXTREME_VALUES for distinct, _ in ends):
            return np.concatenate([ends[0][0], ends[1][0]]), np.concatenate([ends[0][1], ends[1][1]])
    return np.unique(values, return_counts=True)


def _distinct_values(values: Array) -> tuple[Array, Integers]:
    """Return the distinct ones of at least one value, and how often each occurs, as numpy does in twice the time."""
    values.sort()
    starts = np.flatnonzero(np.concatenate([[True], values[1:] != values[:-1]]))
    return values[starts], np.diff(starts, append=len(values))


def merge_extremes(
    old_values: Array, old_counts: Integers, new_values: Array, new_counts: Integers, highest: bool = False
) -> tuple[Array, Integers]:
    """The distinct values nearest one end among old and new ones, outermost first, with their summed counts."""
    values, counts = new_values, new_counts  # sorted
    if len(old_values):
        values, place = np.unique(np.r_[old_values, new_values], return_inverse=True)
        counts = np.bincount(place, np.r_[old_counts, new_counts], len(values)).astype(np.int64)
    order = slice(None, -EXTREME_VALUES - 1, -1) if highest else slice(EXTREME_VALUES)
    return values[order], counts[order]
