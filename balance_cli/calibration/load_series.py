"""Loading sequences: stretches of rows in which the same loads are moved, one after another.

Every sequence has a zero of its own: between them weights are taken off and pans hung elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.least_squares import subtract_block_means

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# Of a load's full range: what counts as a movement.
MIN_LOAD_CHANGE = 0.01
# Rows that make a sequence; a shorter stretch belongs to the one before it.
MIN_SERIES_ROWS = 3
# Of what one zero for each run leaves of the loads, what zeros for each sequence must leave.
MIN_SEPARATION = 0.1


def find_load_series(x: Array, run: Index) -> Index:
    """The sequence (m,) of each row of loads x (m, n), in units of full range; runs (m,), or the

    stretches of them in one attitude, are never one sequence.

    A sequence ends where other loads begin to move than those that moved in it; a load that hangs did not. Where loads
    stand still between changes of all of them, as when each point is hung by itself, the run is one sequence; so is
    every run where zeros for shorter stretches would leave some loads untold.
    """
    found = np.zeros(len(x), dtype=np.intp)
    number = -1
    for name in dict.fromkeys(run.tolist()):
        rows = np.flatnonzero(run == name)
        starts = _drop_constant_series(_series_starts(np.abs(np.diff(x[rows], axis=0)) > MIN_LOAD_CHANGE), x[rows])
        found[rows] = number + 1 + np.searchsorted(starts, np.arange(len(rows)), side="right") - 1
        number = int(found[rows[-1]])
    runs = np.unique(run, return_inverse=True)[1]
    return found if _load_separation(x, found) >= MIN_SEPARATION * _load_separation(x, runs) else runs


def _load_separation(x: Array, block: Index) -> float:
    """The least singular value of loads x (m, n) of unit size less their means in each block, never loaded ones out."""
    size = np.linalg.norm(x, axis=0)
    loaded = size > 0
    if not loaded.any():
        return 0.0
    return float(np.linalg.svd(subtract_block_means(x, block)[:, loaded] / size[loaded], compute_uv=False)[-1])


def _series_starts(load_changed: NDArray[np.bool_]) -> list[int]:
    """Rows at which sequences start, from what (m-1, n) moved between each row and the next."""
    starts, known = [0], np.zeros(load_changed.shape[1], bool)
    for row, now in enumerate(load_changed):
        if not np.any(now & ~known):
            continue
        # The row from which the new load moves on is the end of one sequence; the first moved row starts the next.
        if np.any(known) and row + 1 - starts[-1] >= MIN_SERIES_ROWS:
            starts.append(row + 1)
            # What is hung up or taken off before the first row does not move in the sequence.
            known = np.zeros_like(now)
        else:
            known |= now
    return starts


def _drop_constant_series(starts: list[int], x: Array) -> list[int]:
    """Without the starts of sequences in which nothing moves: a zero of their own would say all that they say."""
    while len(starts) > 1:
        still = [
            k
            for k, (first, end) in enumerate(zip(starts, [*starts[1:], len(x)], strict=True))
            if not np.any(np.ptp(x[first:end], axis=0) > MIN_LOAD_CHANGE)
        ]
        if not still:
            break
        del starts[max(still[0], 1)]
    return starts


def describe_load_series(rows: Index, run: str, loads: Sequence[str], x: Array) -> str:
    """In words: `static-bare rows 21 to 40 (Fy)`, from rows (counted in the run) and loads x of the whole run."""
    load_changed = np.ptp(x[rows], axis=0) > MIN_LOAD_CHANGE
    names = ", ".join(name for name, is_moved in zip(loads, load_changed, strict=True) if is_moved) or "nothing moved"
    return f"{run} rows {rows[0] + 1} to {rows[-1] + 1} ({names})"
