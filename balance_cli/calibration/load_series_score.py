"""Scores by which readings of a load schedule are compared: each is fitted with a zero for each of its load series."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.block_zeros import subtract_block_means
from balance_cli.calibration.load_series import MIN_LOAD_CHANGE, intruding_rows
from balance_cli.calibration.robust_fit import SCALE_FLOOR, RobustFit, fit_robustly

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

MAX_SCALED_SQUARE = 25.0
"""Squared error over its robust variance at which it is clipped (5 sigma), so that an outlier does not decide."""
MIN_LEFT_SHARE = 0.1
"""Floor of 1 - leverage, so that a row that alone determines a zero does not decide."""
MIN_DOF = 4
"""Degrees of freedom that rows must leave by which readings are compared: those of two zeros and two rows more."""
ROWS_PER_COLUMN = 3
"""Rows for each column of the model by which readings are compared: with fewer it has the loads alone."""


@dataclass(frozen=True)
class ScheduleRows:
    """Rows of all runs: loads x (m, k) in units of the calibrated range, readings (m, c), and whether they are `used`.

    `segment` (m,): number of the run, or of the segment of constant attitude; `run` (m,): index into `run_names`.
    `stated` (m,): labels of the load series, empty where a run states none; `tare` (m,): rows stated to be tare points.
    """

    x: Array
    channels: Array
    used: Mask
    segment: Index
    run: Index
    run_names: tuple[str, ...]
    stated: tuple[str, ...]
    tare: Mask


class ReadingScore:
    """Scores of readings: clipped squared errors over their robust variance, plus the price of the zeros."""

    def __init__(self, rows: ScheduleRows, readings: Sequence[Index]) -> None:
        """Take the rows that stand in their place, but no loaded outlier of the best of `readings` (m,)."""
        # Rows that stand in the wrong place would decide by their own errors.
        parts = [np.flatnonzero(rows.segment == number) for number in np.unique(rows.segment)]
        regular = np.concatenate([part[~intruding_rows(rows.x[part])] for part in parts])
        # A row with a wrong sign, or a series with a wrong gain, bends the fit of its whole load: clipping its own
        # errors is not enough. A tare point bends none, and the readings differ by its place.
        loaded = ~_at_tare(rows.x, rows.segment)[regular]
        fit = _best_robust_fit(rows.x[regular], rows.channels[regular], [series[regular] for series in readings])
        zeros = max(len(np.unique(series[regular])) for series in readings)
        kept = ~(fit.deviates & loaded)
        # Where hardly more rows would be left than a fit has parameters, any reading would fit them.
        is_enough = np.count_nonzero(kept) >= rows.x.shape[1] + zeros + MIN_DOF
        self._rows = regular[kept] if is_enough else regular
        self._x, self._channels = rows.x[self._rows], rows.channels[self._rows]
        # That of the reading that fits best: others would hide the errors by which they are to be judged.
        self._scale = np.min([self._robust_scale(series) for series in readings], axis=0)

    def score(self, load_series: Index) -> float:
        """Score of one reading (m,), less is better; infinite where it does not determine the loads."""
        block = np.unique(load_series[self._rows], return_inverse=True)[1]
        errors = self._errors(block)
        if errors is None:
            return float("inf")
        squares = np.mean((errors / self._scale) ** 2, axis=1)
        return float(np.sum(np.minimum(squares, MAX_SCALED_SQUARE)) + len(np.unique(block)) * np.log(len(block)))

    def is_general(self, few: Index, many: Index) -> bool:
        """Whether most of the series of one reading (m,) that another one splits are fitted better by the latter.

        A wrong gain, or two channels exchanged, in one series resembles a shifted zero between its two directions: a
        single one of several series, or one of two, decides nothing. A reading without more series, and so without more
        zeros, is judged by its score.
        """
        few, many = few[self._rows], many[self._rows]
        if len(np.unique(many)) <= len(np.unique(few)):
            return True
        errors = [self._errors(np.unique(block, return_inverse=True)[1]) for block in (few, many)]
        if errors[0] is None or errors[1] is None:
            return False
        gain = np.mean((errors[0] / self._scale) ** 2 - (errors[1] / self._scale) ** 2, axis=1)
        split = [name for name in np.unique(few) if len(np.unique(many[few == name])) > 1]
        gains = [float(np.sum(gain[few == name])) for name in split]
        if len(gains) < min(2, len(np.unique(few))):
            return False
        return bool(np.sort(gains)[(len(gains) - 1) // 2] > np.log(len(few)))

    def _robust_scale(self, load_series: Index) -> Array:
        """Robust standard deviation (c,) of the errors of one reading (m,); infinite where it determines no loads."""
        errors = self._errors(np.unique(load_series[self._rows], return_inverse=True)[1])
        if errors is None:
            return np.full(self._channels.shape[1], np.inf)
        spread = np.maximum(np.ptp(self._channels, axis=0), 1e-300)
        return np.asarray(np.maximum(1.4826 * np.median(np.abs(errors), axis=0), SCALE_FLOOR * spread))

    def _errors(self, block: Index) -> Array | None:
        """Errors (m, c) scaled to the variance of a row, of a fit with a zero for each block (m,)."""
        x = self._x
        zeros = len(np.unique(block))
        columns = [x, np.abs(x), x**2] if len(x) > ROWS_PER_COLUMN * (3 * x.shape[1] + zeros) else [x]
        if len(x) <= x.shape[1] + zeros:
            return None
        A = subtract_block_means(np.hstack(columns), block)
        U, s, _ = np.linalg.svd(A, full_matrices=False)
        Q = U[:, s > 1e-9 * max(s[0], 1e-300)]
        y = subtract_block_means(self._channels, block)
        left = 1.0 - np.sum(Q**2, axis=1) - 1.0 / np.bincount(block)[block]
        return np.asarray((y - Q @ (Q.T @ y)) / np.sqrt(np.maximum(left, MIN_LEFT_SHARE))[:, None])


def _best_robust_fit(x: Array, channels: Array, readings: Sequence[Index]) -> RobustFit:
    """Of the robust fits of all readings (m,) of the schedule the one with the least scale."""
    different = {series.tobytes(): np.unique(series, return_inverse=True)[1] for series in readings}
    fits = [fit_robustly(x, channels, block) for block in different.values()]
    return min(fits, key=lambda fit: float(np.sum(np.log(fit.scale))))


def _at_tare(x: Array, segment: Index) -> Mask:
    """Rows (m,) of the loads x (m, k) that are unloaded, or loaded as the first row of their segment (m,)."""
    _, first, inverse = np.unique(segment, return_index=True, return_inverse=True)
    unloaded, as_first = (np.all(np.abs(x - base) <= MIN_LOAD_CHANGE, axis=1) for base in (0.0, x[first[inverse]]))
    return np.asarray(unloaded | as_first)
