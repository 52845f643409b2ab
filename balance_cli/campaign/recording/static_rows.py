"""Load points of a static run that a channel did not read are left out, so that the channel is not.

Between load points nothing can be interpolated. Without the row, every channel has one reading less, and uncertainties
widen accordingly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.additions import AdditionSource, RunAdditions
from balance_cli.campaign.recording.run import Array, BridgedSamples, MemorySource, Run

LARGEST_ROW_SHARE = 0.05
"""Of the load points that may be left out: a channel that misses more is faulty, and left out instead of them."""
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


def leave_out_unread_rows(run: Run) -> Run:
    """Return a static run without the rows that few channels miss, listed in `bridged`; itself where it has none."""
    if run.samples < FEWEST_ROWS:
        return run
    block = run.read()
    missing = ~np.isfinite(block.channels)
    most = max(1, int(LARGEST_ROW_SHARE * run.samples))
    count = missing.sum(axis=0)
    partly = [int(column) for column in np.argsort(count) if 0 < count[column] <= most]
    while partly and missing[:, partly].any(axis=1).sum() > most:
        partly.pop()  # the channel that misses most
    if not partly:
        return run
    kept = np.flatnonzero(~missing[:, partly].any(axis=1))
    nothing = np.empty(0)
    listed = (
        BridgedSamples(run.channel_names[column], np.flatnonzero(missing[:, column]), nothing, nothing[None])
        for column in sorted(partly)
    )
    return replace(_with_rows(run, kept), bridged=tuple(listed))


def _with_rows(run: Run, kept: NDArray[np.intp]) -> Run:
    """Return the selected rows of a run, with all that belongs to them."""
    block = run.read()
    return replace(
        run,
        samples=len(kept),
        source=MemorySource(block.channels[kept], None if block.loads is None else block.loads[kept]),
        attitude=None if run.attitude is None else run.attitude[kept],
        series_labels=_select(run.series_labels, kept),
        point_kinds=_select(run.point_kinds, kept),
        additions=_select_additions(run, kept),
    )


def _select(labels: Sequence[T] | None, rows: NDArray[np.intp]) -> tuple[T, ...] | None:
    return None if labels is None else tuple(labels[row] for row in rows)


def _select_additions(run: Run, rows: NDArray[np.intp]) -> RunAdditions | None:
    additions = run.additions
    if additions is None or additions.source is None:
        return additions
    return replace(additions, source=_SelectedRows(additions.source, rows, run.samples))


def describe_rows(bridged: Sequence[BridgedSamples]) -> str:
    """Return in words which rows of a file were left out, counted from 1, and for which channels."""
    rows = sorted({int(row) + 1 for item in bridged for row in item.index})
    names = ", ".join(item.name for item in bridged)
    which = f"load point {rows[0]}" if len(rows) == 1 else f"load points {', '.join(map(str, rows))}"
    verb = "is" if len(rows) == 1 else "are"
    return f"{which} of the file {verb} left out, where {names} is not finite; the rest is numbered without"
