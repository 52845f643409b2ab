"""Loads that stand in the wrong row or have the wrong sign, found before load series are read or terms are selected.

In a short table two exchanged rows spoil both the load series, which are read from the loads, and every fit that would
show them. Each exchange of two rows, and each reversal of one, is therefore tried: undone, it leaves far smaller errors
than the table as it is, and than any other. Rows that could as well be left out decide nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.block_zeros import subtract_block_means
from balance_cli.calibration.load_series_score import ScheduleRows

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MOST_ROWS = 100
"""With more rows a robust fit finds misplaced loads."""
MOST_TRIED_ROWS = 30
"""Rows, those of the largest errors, that are tried: 435 pairs. In a table of so few rows each error hides in all."""
MIN_DIFFERENCE = 0.05
"""Share of the calibrated range by which two loads differ that are exchanged to any effect."""
DECISIVE_SCORE = 10.0
"""Very strong evidence (Kass and Raftery, JASA 90, 1995); twice the logarithm of the number of trials is added."""
MIN_ERROR = 100.0
"""Sum of squares that the mistake explains, over the variance that is left: two rows 7 standard deviations off."""
MIN_DOF = 3
"""Degrees of freedom; a row that is left out takes one with it."""
TRIALS_AT_ONCE = 512
"""Trials in one array: 512 schedules of 100 rows and 6 loads are 2.5 MB."""


@dataclass(frozen=True)
class MisplacedLoads:
    """The `rows` of an exchange (two) or a reversal (one), and the loads x (m, k) without it."""

    rows: tuple[int, ...]
    x: Array


def find_misplaced_loads(rows: ScheduleRows) -> MisplacedLoads | None:
    """Find the one exchange or reversal of loads x (m, k) that explains the readings; None where none is decisive."""
    loaded = np.ptp(rows.x, axis=0) > 0
    block = _blocks(rows)
    dof = len(rows.x) - int(np.count_nonzero(loaded)) - int(block.max()) - 1
    if len(rows.x) > MOST_ROWS or dof < MIN_DOF:
        return None
    channels = subtract_block_means(rows.channels, block)
    trials = _trials(rows, _rows_of_largest_errors(rows.x[:, loaded], channels, block))
    if not trials:
        return None
    schedules = [_undo(rows.x, trial) for trial in trials]
    left = _residual_errors([rows.x[:, loaded], *(x[:, loaded] for x in schedules)], channels, block)
    score = _score(left, channels, dof, dof)
    best = 1 + int(np.argmin(score[1:]))
    without = _residual_errors(
        [np.column_stack([rows.x[:, loaded], row]) for row in np.eye(len(rows.x))], channels, block
    )
    others = [row for row in range(len(rows.x)) if (row,) != trials[best - 1]]
    rivals = np.r_[np.delete(score, best), _score(without, channels, dof - 1, dof)[others]]
    decisive = DECISIVE_SCORE + 2.0 * np.log(len(trials))
    explained = float(np.median((left[0] - left[best]) / np.maximum(left[best] / dof, np.finfo(float).tiny)))
    if score[best] > np.min(rivals) - decisive or explained < MIN_ERROR:
        return None
    return MisplacedLoads(trials[best - 1], schedules[best - 1])


def _score(left: Array, channels: Array, dof: int, rows: int) -> Array:
    """Score (t,) of sums of squares (t, c) with their degrees of freedom, less is better: as if all channels were one.

    Errors of the channels are alike, where loads were misaligned or the balance creeps.
    """
    floor = np.finfo(float).eps ** 2 * np.sum(channels**2, axis=0) + np.finfo(float).tiny
    return np.asarray(rows * np.mean(np.log(np.maximum(left, floor) / dof), axis=1))


def _blocks(rows: ScheduleRows) -> Index:
    """Block (m,) of one zero: the stated load series, else the segment, whose zeros hardly differ beside a mistake."""
    names = rows.stated if all(rows.stated) else tuple(str(number) for number in rows.segment.tolist())
    return np.asarray(np.unique(names, return_inverse=True)[1], np.intp)


def _rows_of_largest_errors(x: Array, channels: Array, block: Index) -> list[int]:
    """The rows of the largest errors, in their order."""
    Q = np.linalg.qr(subtract_block_means(x, block))[0]
    errors = channels - Q @ (Q.T @ channels)
    size = np.sum(errors**2 / np.maximum(np.mean(errors**2, axis=0), np.finfo(float).tiny), axis=1)
    return sorted(np.argsort(-size, kind="stable")[:MOST_TRIED_ROWS].tolist())


def _trials(rows: ScheduleRows, rows_to_test: list[int]) -> list[tuple[int, ...]]:
    """Rows that may have been exchanged, and rows that may have the wrong sign."""
    x = rows.x
    pairs = [
        (i, j)
        for i, j in combinations(rows_to_test, 2)
        if rows.run[i] == rows.run[j] and np.max(np.abs(x[i] - x[j])) > MIN_DIFFERENCE
    ]
    return [*pairs, *((i,) for i in rows_to_test if np.max(np.abs(x[i])) > MIN_DIFFERENCE)]


def _undo(x: Array, trial: tuple[int, ...]) -> Array:
    """The loads with two rows exchanged, or one reversed."""
    corrected = x.copy()
    corrected[list(trial)] = x[list(trial[::-1])] if len(trial) == 2 else -x[list(trial)]
    return corrected


def _residual_errors(schedules: list[Array], channels: Array, block: Index) -> Array:
    """Sum of squares (t, c) that the loads of each schedule (m, k) leave of the readings (m, c), less their means."""
    share = (np.arange(int(block.max()) + 1)[:, None] == block) / np.bincount(block)[:, None]
    left = []
    for first in range(0, len(schedules), TRIALS_AT_ONCE):
        x = np.stack(schedules[first : first + TRIALS_AT_ONCE])
        Q = np.linalg.qr(x - (share @ x)[:, block])[0]
        left.append(np.sum((channels - Q @ (Q.transpose(0, 2, 1) @ channels)) ** 2, axis=1))
    return np.concatenate(left)
