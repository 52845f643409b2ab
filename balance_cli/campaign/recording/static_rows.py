"""Load points of a static run that are left out: unread ones, so that a channel is not, and those entered twice.

Between load points nothing can be interpolated. Without the row, every channel has one reading less, and uncertainties
widen accordingly. A row that was entered twice looks like a repeated reading without noise, from which the uncertainty
of all readings would follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc

from balance_cli.campaign.recording.additions import AdditionSource, RunAdditions
from balance_cli.campaign.recording.run import Array, BridgedSamples, MemorySource, Run
from balance_cli.campaign.rig.components import COMPONENTS

LARGEST_ROW_SHARE = 0.05
"""Of the load points that may be left out: a channel that misses more is faulty, and left out instead of them."""
FEWEST_COPIED_ROWS = 5
"""Load points that are followed by a copy of all of them; so many do not agree in every digit by accident."""
COPIES_P_VALUE = 1e-3
"""P-value of so many equal consecutive rows, below which resolution does not explain them."""
MOST_LISTED = 10
"""Numbers of load points in a message."""
FEWEST_ROWS = 10
"""Load points from which one may be left out; fewer are each needed for a coefficient."""

T = TypeVar("T")


@dataclass(frozen=True)
class _SelectedRows:
    """Selected rows of the datasets beside the samples."""

    measured: AdditionSource
    rows: NDArray[np.intp]
    total: int

    def read(self, dataset: str, start: int, stop: int) -> Array:
        """Rows start to stop of those selected."""
        return self.measured.read(dataset, 0, self.total)[self.rows[start:stop]]


def leave_out_rows(run: Run) -> Run:
    """Return a static run without unread and copied rows, which it lists in `bridged` and `copied_rows`.

    A row is unread where a load, or one of the channels that miss few rows, is not finite. It is copied where it
    repeats the row before it, or its load series one with another label, or the second half of the rows the first half,
    in every digit.
    """
    block = run.read()
    names = (*run.channel_names, *(COMPONENTS if block.loads is not None else ()))
    values = block.channels if block.loads is None else np.hstack([block.channels, block.loads])
    unread = _unread_rows(values, len(run.channel_names))
    copied = _copied_rows(values, len(run.channel_names)) | _copied_series(values, run.series_labels)
    dropped = unread.any(axis=1) | copied
    if not dropped.any():
        return run
    nothing = np.empty(0)
    listed = (
        BridgedSamples(name, np.flatnonzero(missing), nothing, nothing[None])
        for name, missing in zip(names, unread.T, strict=True)
        if missing.any()
    )
    copies = tuple(np.flatnonzero(copied).tolist())
    return replace(_with_rows(run, np.flatnonzero(~dropped)), bridged=tuple(listed), copied_rows=copies)


def _unread_rows(values: Array, channels: int) -> NDArray[np.bool_]:
    """Return which values (n, c) make their row one to leave out: loads, and channels that miss few rows."""
    missing = ~np.isfinite(values)
    rows = len(values)
    if rows < FEWEST_ROWS or not missing.any():
        return np.zeros_like(missing)
    most = max(1, int(LARGEST_ROW_SHARE * rows))
    count = missing.sum(axis=0)
    partly = [int(column) for column in np.argsort(count) if 0 < count[column] <= most]
    # A load that too many rows lack is a fault of the run; it costs no rows.
    partly.sort(key=lambda column: (column < channels, count[column]))
    while partly and missing[:, partly].any(axis=1).sum() > most:
        partly.pop()  # the channel that misses most
    unread = np.zeros_like(missing)
    unread[:, partly] = missing[:, partly]
    return unread


def _copied_rows(values: Array, channels: int) -> NDArray[np.bool_]:
    """Return which rows (n,) of channels and loads repeat others in every digit, as rows do that were entered twice.

    Unloaded rows count only beside loaded ones: a tared instrument reads the same zero again and again.
    """
    rows = len(values)
    copied = np.zeros(rows, bool)
    half = rows // 2
    if rows % 2 == 0 and half >= FEWEST_COPIED_ROWS and np.array_equal(values[:half], values[half:]):
        copied[half:] = bool(np.any(values != values[0]))
        return copied
    copied[1:] = np.all(values[1:] == values[:-1], axis=1)
    loaded = np.any(values[:, channels:] != 0.0, axis=1) & np.any(values[:, :channels] != 0.0, axis=1)
    if not np.any(copied & loaded) or _agrees_by_resolution(values[:, :channels], values[:, channels:]):
        return np.zeros(rows, bool)
    return copied


def _copied_series(values: Array, labels: tuple[str, ...] | None) -> NDArray[np.bool_]:
    """Return which rows (n,) of channels and loads are of a load series that repeats an earlier one in every digit."""
    copied, seen = np.zeros(len(values), bool), set[bytes]()
    for label in dict.fromkeys(labels or ()):
        rows = np.array([other == label for other in labels or ()])
        series = values[rows]
        if np.count_nonzero(np.any(series != series[0], axis=1)) >= FEWEST_COPIED_ROWS:
            copied |= rows & (series.tobytes() in seen)
            seen.add(series.tobytes())
    return copied


def _agrees_by_resolution(readings: Array, loads: Array) -> bool:
    """Whether readings (n, c) at equal loads (n, k) are so coarse that consecutive ones agree in every digit by chance.

    Consecutive ones that do not agree then differ by a unit of the last digit, or others at equal loads agree as often.
    """
    group = np.unique(loads, axis=0, return_inverse=True)[1].reshape(-1)
    order = np.argsort(group, kind="stable")
    order = order[np.any(readings[order] != 0.0, axis=1)]
    before, after = order[:-1], order[1:]
    same = group[before] == group[after]
    before, after = before[same], after[same]
    steps = np.max(np.abs(readings[after] - readings[before]) / _last_digits(readings), axis=1)
    beside, equal = after == before + 1, steps == 0.0
    if np.any(beside & ~equal) and np.median(steps[beside & ~equal]) < 1.5:
        return True
    share = float(np.mean(equal[~beside])) if np.any(~beside) else 0.0
    return bool(bdtrc(np.sum(equal[beside]) - 1, np.sum(beside), share) > COPIES_P_VALUE)


def _last_digits(readings: Array) -> Array:
    """Unit (c,) of the last digit of readings (n, c): the least of their differences."""
    gaps = np.diff(np.sort(readings, axis=0), axis=0)
    rounding = 1e-9 * np.ptp(readings, axis=0)
    return np.asarray(np.min(np.where(gaps > rounding, gaps, np.inf), axis=0))


def _with_rows(run: Run, rows: NDArray[np.intp]) -> Run:
    """Return the selected rows of a run, with all that belongs to them."""
    block = run.read()
    return replace(
        run,
        samples=len(rows),
        source=MemorySource(block.channels[rows], None if block.loads is None else block.loads[rows]),
        attitude=None if run.attitude is None else run.attitude[rows],
        series_labels=_select(run.series_labels, rows),
        point_kinds=_select(run.point_kinds, rows),
        additions=_select_additions(run, rows),
    )


def _select(labels: Sequence[T] | None, rows: NDArray[np.intp]) -> tuple[T, ...] | None:
    return None if labels is None else tuple(labels[row] for row in rows)


def _select_additions(run: Run, rows: NDArray[np.intp]) -> RunAdditions | None:
    additions = run.additions
    if additions is None or additions.source is None:
        return additions
    return replace(additions, source=_SelectedRows(additions.source, rows, run.samples))


def describe_rows(run: Run) -> str:
    """Return in words which rows of the file a static run leaves out, counted from 1, and why; empty without any."""
    texts = []
    if run.bridged:
        rows = sorted({int(row) for item in run.bridged for row in item.index})
        names = ", ".join(item.name for item in run.bridged)
        texts.append(f"{_left_out(rows)}, where {names} is not finite")
    if run.copied_rows:
        what = "copies of others in every digit: were they entered twice?"
        texts.append(f"{_left_out(run.copied_rows)} as {what}")
    return f"{'; '.join(texts)}; the rest is numbered without" if texts else ""


def _left_out(rows: Sequence[int]) -> str:
    numbers = [str(row + 1) for row in rows[:MOST_LISTED]]
    more = f" and {len(rows) - MOST_LISTED} more" if len(rows) > MOST_LISTED else ""
    noun, verb = ("load point", "is") if len(rows) == 1 else ("load points", "are")
    return f"{noun} {', '.join(numbers)}{more} of the file {verb} left out"
