"""Load series: consecutive rows in which the same loads are varied.

Each load series has its own zero, because weights are removed and pans are moved between series.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.least_squares import subtract_block_means

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MIN_LOAD_CHANGE = 0.01
"""Share of the calibrated range by which a load must change: above load noise, below the steps of a calibration."""
MIN_SERIES_ROWS = 3
"""Rows in a load series at least, so that a zero and a slope leave a residual; fewer rows join the previous series."""
MIN_SEPARATION = 0.1
"""Least singular value of the loads with one zero per series, over that with one zero per run.

Below it the series zeros would explain most of the variation of some loads, and each run keeps one zero.
"""


def find_load_series(x: Array, run: Index) -> Index:
    """Number (m,) of the load series of each row of loads x (m, n), in units of the calibrated range.

    A load series never extends over two runs (m,), or over two segments of constant attitude where `run` numbers those.
    It ends where a load begins to change that was constant in it. Where all loads change at once from row to row, the
    run is one load series; so is every run where shorter series would leave some loads undetermined.
    """
    load_series = np.zeros(len(x), dtype=np.intp)
    number = -1
    for name in dict.fromkeys(run.tolist()):
        rows = np.flatnonzero(run == name)
        starts = _drop_constant_series(_series_starts(np.abs(np.diff(x[rows], axis=0)) > MIN_LOAD_CHANGE), x[rows])
        load_series[rows] = number + 1 + np.searchsorted(starts, np.arange(len(rows)), side="right") - 1
        number = int(load_series[rows[-1]])
    runs = np.unique(run, return_inverse=True)[1]
    return load_series if _load_separation(x, load_series) >= MIN_SEPARATION * _load_separation(x, runs) else runs


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
