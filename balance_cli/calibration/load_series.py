"""Load series: consecutive rows in which the same loads are varied.

Each load series has its own zero, because weights are removed and pans are moved between series. A series may open with
its tare point, close with one, do both or neither. The loads alone do not tell to which of two series an unloaded row
between them belongs; `load_series_reading` lets the readings decide.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.block_zeros import subtract_block_means

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MIN_LOAD_CHANGE = 0.01
"""Share of the calibrated range by which a load must change: above load noise, below the steps of a calibration."""
MIN_SERIES_ROWS = 3
"""Rows in a load series at least, so that a zero and a slope leave a residual; fewer rows join the previous series."""
MAX_INTRUDING_SHARE = 0.05
"""Share of the rows that may intrude, as that of outliers; more of them are single loads that were meant."""
MIN_RETURNS = 2
"""Returns to a first load that is not zero from which it is a tare point, and not a load that was applied twice."""
LARGE_STEP_RATIO = 1.5
"""A return to the tare that is so many times the next step is no step of a ramp, whose steps are about equal."""
MIN_SEPARATION = 0.1
"""Least singular value of the loads with one zero per series, over that with one zero per run.

Below it the series zeros would explain most of the variation of some loads, and each run keeps one zero.
"""

TARE_LAST, TARE_FIRST, SPLIT_LAST, SPLIT_FIRST = "last", "first", "split-last", "split-first"
EACH_TARE, EACH_RETURN, EACH_SIGN, EACH_CLOSING = "each", "each-return", "each-sign", "each-closing"
TARE_POSITIONS = (TARE_LAST, TARE_FIRST, SPLIT_LAST, SPLIT_FIRST, EACH_TARE, EACH_SIGN, EACH_RETURN, EACH_CLOSING)
"""Where the tare points of load series stand.

`last`: an unloaded row between two series closes the earlier one; `first`: it opens the later one; `split-last` and
`split-first`: the same, but two unloaded rows in succession belong to one series each; `each`: a series opens wherever
the loads return to their first value at once, also where the same load is varied again; `each-return`: also where they
return to it by a step of the ramp, as between the two directions of a load; `each-closing`: as `each-return`, but the
return is to the last value of the loads and closes a series; `each-sign`: also where a load changes its
sign from one row to the next, as between two directions whose tare points stand in their midst.
"""


def find_load_series(x: Array, run: Index) -> Index:
    """Number (m,) of the load series of each row of loads x (m, n), in units of the calibrated range.

    A load series never extends over two runs (m,), or over two segments of constant attitude where `run` numbers those.
    It ends where a load begins to change that was constant in it; a tare point between two of them belongs to the
    earlier one. Where all loads change at once from row to row, the run is one load series; so is every run
    where shorter series would leave some loads undetermined.
    """
    load_series = np.zeros(len(x), dtype=np.intp)
    number = -1
    for name in dict.fromkeys(run.tolist()):
        rows = np.flatnonzero(run == name)
        load_series[rows] = number + 1 + split_rows(x[rows], TARE_LAST)
        number = int(load_series[rows[-1]])
    runs = np.unique(run, return_inverse=True)[1]
    return load_series if determines_loads(x, load_series, runs) else runs


def determines_loads(x: Array, load_series: Index, runs: Index) -> bool:
    """Whether one zero for each load series (m,) leaves the loads x (m, n) determined as those of each run (m,) do."""
    return _load_separation(x, load_series) >= MIN_SEPARATION * _load_separation(x, runs)


def split_rows(x: Array, position: str) -> Index:
    """Number (m,) from 0 of the load series of each row of one run, loads x (m, n)."""
    if position == EACH_CLOSING:
        backwards = split_rows(x[::-1], EACH_RETURN)
        return np.asarray(backwards[-1] - backwards[::-1], np.intp)
    if position in (TARE_FIRST, SPLIT_FIRST, EACH_TARE, EACH_RETURN, EACH_SIGN):
        # Backwards in time a tare point that opens a series closes it.
        starts = sorted(len(x) - start for start in _starts(x[::-1])[1:])
        starts = [0, *starts]
    else:
        starts = _starts(x)
    if position in (SPLIT_LAST, SPLIT_FIRST):
        starts = [_between_tares(x, start) for start in starts]
    if position in (EACH_TARE, EACH_RETURN, EACH_SIGN):
        base = np.zeros_like(x[0]) if position == EACH_SIGN or _unloaded(x).any() else x[0]
        returns = _returns_to_load(x, base, 0.0 if position == EACH_RETURN else LARGE_STEP_RATIO)
        # Of two tare points the loads may have taken the other one.
        others = [start for start in starts if all(abs(start - row) >= MIN_SERIES_ROWS for row in returns)]
        starts = sorted({0, *others, *returns})
    if position == EACH_SIGN:
        starts = sorted({*starts, *_sign_changes(x)})
    return np.asarray(np.searchsorted(starts, np.arange(len(x)), side="right") - 1, np.intp)


def _starts(x: Array) -> list[int]:
    return _drop_constant_series(_series_starts(np.abs(np.diff(x, axis=0)) > MIN_LOAD_CHANGE), x)


def _unloaded(x: Array) -> NDArray[np.bool_]:
    """Rows (m,) without load: where there are any, they and no first load are the tare points."""
    return np.asarray(np.all(np.abs(x) <= MIN_LOAD_CHANGE, axis=1))


def _between_tares(x: Array, start: int) -> int:
    """Move a start (row) between two equal rows, one of which would be the wrong side of it."""
    same = np.all(np.abs(np.diff(x, axis=0)) <= MIN_LOAD_CHANGE, axis=1)
    if 0 < start < len(x) and not same[start - 1]:
        if start >= 2 and same[start - 2]:
            return start - 1
        if start < len(same) and same[start]:
            return start + 1
    return start


def _sign_changes(x: Array) -> list[int]:
    """Rows at which a load has the other sign than in the row before; none where a series would be too short."""
    loaded = (np.abs(x[1:]) > MIN_LOAD_CHANGE) & (np.abs(x[:-1]) > MIN_LOAD_CHANGE)
    rows = (1 + np.flatnonzero(np.any(loaded & (x[1:] * x[:-1] < 0.0), axis=1))).tolist()
    return rows if min(np.diff([0, *rows, len(x)]), default=0) >= MIN_SERIES_ROWS else []


def _returns_to_load(x: Array, base: Array, ratio: float) -> list[int]:
    """Rows at which all loads return to the tare, `base` (n,), in a step above `ratio` times the one that follows.

    Two such rows in succession are two tare points, whatever the steps: the second opens a series. None where a load
    series would be too short.
    """
    at_base = np.all(np.abs(x - base) <= MIN_LOAD_CHANGE, axis=1)
    step = np.linalg.norm(np.diff(x, axis=0), axis=1)
    returns = [row for row in range(1, len(x) - 1) if at_base[row] and not at_base[row - 1] and not at_base[row + 1]]
    repeated = [row for row in range(2, len(x) - 1) if at_base[row - 1] and at_base[row] and not at_base[row + 1]]
    jumps = sorted({*(row for row in returns if step[row - 1] > ratio * step[row]), *repeated})
    shortest = min(np.diff([0, *jumps, len(x)]), default=0)
    enough = 1 if not np.any(base) else MIN_RETURNS
    is_tare = len(returns) + len(repeated) >= enough and shortest >= MIN_SERIES_ROWS
    return jumps if is_tare else []


def intruding_rows(x: Array) -> NDArray[np.bool_]:
    """Rows (m,) of loads x (m, n) with a load that neither neighbor has, as after an exchange of two rows.

    None where there are so many that such rows belong to the schedule.
    """
    if len(x) < MIN_SERIES_ROWS:
        return np.zeros(len(x), bool)
    active = np.abs(x - x[0]) > MIN_LOAD_CHANGE
    before, after = np.vstack([active[1:2], active[:-1]]), np.vstack([active[1:], active[-2:-1]])
    intruding = np.any(active & ~before & ~after, axis=1)
    return (
        intruding if np.count_nonzero(intruding) <= max(2, MAX_INTRUDING_SHARE * len(x)) else np.zeros_like(intruding)
    )


def _load_separation(x: Array, block: Index) -> float:
    """Least singular value of the loads x (m, n) less block means, columns of unit norm; unloaded ones omitted."""
    size = np.linalg.norm(x, axis=0)
    loaded = size > 0
    if not loaded.any():
        return 0.0
    return float(np.linalg.svd(subtract_block_means(x, block)[:, loaded] / size[loaded], compute_uv=False)[-1])


def _series_starts(load_changed: NDArray[np.bool_]) -> list[int]:
    """Rows at which load series start, from the loads that changed (m-1, n) between each row and the next."""
    starts, known = [0], np.zeros(load_changed.shape[1], bool)
    for row, changed in enumerate(load_changed):
        if not np.any(changed & ~known):
            continue
        # The last row before the new load changes ends one series; the row after it starts the next.
        if np.any(known) and row + 1 - starts[-1] >= MIN_SERIES_ROWS:
            starts.append(row + 1)
            # Weights hung or removed before the first row are constant in the series.
            known = np.zeros_like(changed)
        else:
            known |= changed
    return starts


def _drop_constant_series(starts: list[int], x: Array) -> list[int]:
    """Merge load series in which no load changes with their neighbor: their own zero would fit them exactly."""
    while len(starts) > 1:
        constant = [
            k
            for k, (first, end) in enumerate(zip(starts, [*starts[1:], len(x)], strict=True))
            if not np.any(np.ptp(x[first:end], axis=0) > MIN_LOAD_CHANGE)
        ]
        if not constant:
            break
        del starts[max(constant[0], 1)]
    return starts


def describe_load_series(rows: Index, run: str, loads: Sequence[str], x: Array) -> str:
    """Describe a load series as `static-bare rows 21 to 40 (Fy)`, from its rows in the run and the run's loads x."""
    load_changed = np.ptp(x[rows], axis=0) > MIN_LOAD_CHANGE
    names = ", ".join(name for name, changed in zip(loads, load_changed, strict=True) if changed) or "nothing moved"
    return f"{run} rows {rows[0] + 1} to {rows[-1] + 1} ({names})"


def describe_all_series(
    load_series: Index,
    used: NDArray[np.bool_],
    run: Index,
    run_names: Sequence[str],
    loads: Sequence[str],
    x: Array,
) -> tuple[str, ...]:
    """Describe each load series that has used rows: its number, the run (index into the names) and x of each row (m,).

    `load_series`, `used`, `run` (m,); x (m, k) as in `describe_load_series`.
    """
    order = np.argsort(load_series, kind="stable")
    _, first, place = np.unique(run, return_index=True, return_inverse=True)
    first = first[place]  # of the run of each row, whose rows are consecutive
    names = np.unique(load_series[used])
    starts, ends = (np.searchsorted(load_series[order], names, side) for side in ("left", "right"))
    descriptions = []
    for start, end in zip(starts, ends, strict=True):
        rows, begin = order[start:end], first[order[start]]
        descriptions.append(describe_load_series(rows - begin, run_names[run[rows[0]]], loads, x[begin:]))
    return tuple(descriptions)
