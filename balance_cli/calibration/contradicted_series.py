"""Load series that all others contradict: these agree with each other without it, and it is far off their prediction.

Where every series varies all loads, as in a schedule by chance, a wrong sign of one load, another unit or two exchanged
channels in a single series spoil the fit of all rows. Each of them then looks wrong, and neither robust fits nor the
gains of single series tell which one is. Series are therefore left out, one by one or two at a time, and more of them
where no line fits, as long as most are left.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.all_trims_result import SuspectLoadSeries
from balance_cli.calibration.block_zeros import subtract_block_means, subtract_mean
from balance_cli.calibration.fit import CalibrationPoints, fit_calibration_model
from balance_cli.calibration.least_squares import CollinearError
from balance_cli.calibration.load_series import describe_load_series
from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.series_causes import series_cause
from balance_cli.calibration.term_choice import TermChoice
from balance_cli.calibration.terms import all_terms, linear_terms, term_values

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

MIN_SERIES = 4
"""Load series of which one may be left out: three that agree with each other are a majority."""
MIN_SERIES_OF_TWO, MAX_SERIES_OF_TWO = 7, 24
"""The same for two, and up to which all pairs are tried: five that agree, and 276 linear fits at the most."""
MIN_MISFIT = 0.01
"""What a line leaves, over the range of the readings, from which sets of more series are tried: one wrong series of
twenty leaves as much, and a sound balance is not kept waiting for sets that none of its series needs."""
MAX_SETS = 2500
"""Sets of one size that are tried: three of 24 series, five of 15; a second for squares and products."""
CLEAR_RATIO = 3.0
"""Least misfit without any other series over that without the wrong one: of eight series, each takes 6 % of it away."""
MIN_ERROR_SHARE = 0.05
"""Error of the rows of a wrong series, in the worst channel, over the range of that channel. Smaller ones are gain
errors, for which series are compared with the terms of the model."""
MIN_WRONG_ROWS, MIN_WRONG_SHARE = 3, 0.25
"""Rows of a wrong series with such errors, and their share: two are exchanged rows, and of loads by chance some are
small."""
MIN_ERROR_RATIO = 10.0
"""The same over the standard error of its prediction: what a straight line misses is no error of one series."""
MIN_DOF = 6
"""Degrees of freedom of the others by which their misfit is known to 30 %; as many as columns at the least."""
LEAST_PREDICTED = 0.05
"""Singular value over the largest, of loads and products over their ranges, from which the others tell all of them."""


def contradicted_series(points: CalibrationPoints, choice: TermChoice) -> tuple[Mask, ...]:
    """Return the rows (m,) of each load series that all others contradict; none where terms of the model explain it.

    Straight lines tell most; where a balance curves as much as a series errs, squares and products do, in long tables.
    """
    used = points.weight > 0
    names = np.unique(points.load_series[used])
    k = len(points.components)
    if len(names) < MIN_SERIES:
        return ()
    for terms in (linear_terms(k), (*linear_terms(k), *(term for term in all_terms(k) if term.is_quadratic))):
        columns = term_values(terms, points.x)
        sums = _sums(points, columns, names)
        for size in _sizes(len(names), float(sums.misfit(np.zeros((1, 0), np.intp))[0])):
            found, misfit = _clearly_best(sums, np.array(list(combinations(range(len(names)), size))))
            rows = tuple(used & (points.load_series == names[place]) for place in found)
            if rows and all(_is_far_off(points, columns, each, rows, misfit) for each in rows):
                return () if is_explained(points, choice, misfit) else rows
    return ()


def _sizes(count: int, misfit: float) -> list[int]:
    """How many of `count` series are left out at a time: a minority, of which all sets are tried."""
    sizes = [1] + [2] * (MIN_SERIES_OF_TWO <= count <= MAX_SERIES_OF_TWO)
    if misfit > MIN_MISFIT:
        sizes += [size for size in range(2, (count + 1) // 2) if size not in sizes and comb(count, size) <= MAX_SETS]
    return sizes


@dataclass(frozen=True)
class _Sums:
    """Of each of s load series, about its means: X'X (s, p, p), X'Y (s, p, c), the squares of Y (s,), rows (s,).

    A fit without some series follows from the sums of the others.
    """

    gram: Array
    cross: Array
    square: Array
    rows: Index

    def misfit(self, left_out: Index) -> Array:
        """Rms (n,) of what fits without each of n sets (n, size) of series leave, over ranges; inf with few rows."""
        gram, cross, square, rows = (
            part.sum(axis=0) - part[left_out].sum(axis=1) for part in (self.gram, self.cross, self.square, self.rows)
        )
        p, c = cross.shape[1:]
        dof = rows - (len(self.rows) - left_out.shape[1]) - p
        singular = np.sqrt(np.maximum(np.linalg.eigvalsh(gram), 0.0))
        is_known = (dof >= max(MIN_DOF, p)) & (singular[:, 0] >= LEAST_PREDICTED * singular[:, -1])
        solvable = np.where(is_known[:, None, None], gram, np.eye(p))
        left = square - np.sum(cross * np.linalg.solve(solvable, cross), axis=(1, 2))
        return np.where(is_known, np.sqrt(np.maximum(left, 0.0) / (np.maximum(dof, 1) * c)), np.inf)


def _sums(points: CalibrationPoints, columns: Array, names: Index) -> _Sums:
    """The sums of each load series of the used rows."""
    parts = [centered_rows(points, columns, (points.weight > 0) & (points.load_series == name)) for name in names]
    return _Sums(
        gram=np.array([x.T @ x for x, _, _ in parts]),
        cross=np.array([x.T @ y for x, y, _ in parts]),
        square=np.array([np.sum(y**2) for _, y, _ in parts]),
        rows=np.array([len(x) for x, _, _ in parts]),
    )


def _clearly_best(sums: _Sums, sets: Index) -> tuple[tuple[int, ...], float]:
    """The set (of n, size) of series without which the others agree far better than without any other; its misfit."""
    misfit = sums.misfit(sets)
    order = np.argsort(misfit)
    # Where most series are needed to tell some load, there are no others that could agree.
    if np.count_nonzero(np.isfinite(misfit)) < max(2, len(misfit) // 2 + 1):
        return (), np.inf
    best, second = misfit[order[:2]]
    return (tuple(map(int, sets[order[0]])) if second >= CLEAR_RATIO * best else ()), float(best)


def _is_far_off(points: CalibrationPoints, columns: Array, rows: Mask, left_out: Iterable[Mask], misfit: float) -> bool:
    """Whether several of some rows (m,) are far from what the rows not left out predict."""
    x, y, _ = centered_rows(points, columns, (points.weight > 0) & ~np.any(list(left_out), axis=0))
    own = columns[rows] - np.median(columns[rows], axis=0)
    errors = points.channels[rows] / reading_ranges(points) - own @ np.linalg.lstsq(x, y, rcond=None)[0]
    errors -= np.median(errors, axis=0)
    sigma = misfit * np.sqrt(1.0 + np.sum(own * np.linalg.solve(x.T @ x, own.T).T, axis=1))
    largest, needed = np.max(np.abs(errors), axis=1), max(MIN_WRONG_ROWS, int(np.ceil(MIN_WRONG_SHARE * len(own))))
    return int(np.sum((largest > MIN_ERROR_SHARE) & (largest > MIN_ERROR_RATIO * sigma))) >= needed


def is_explained(points: CalibrationPoints, choice: TermChoice, misfit: float) -> bool:
    """Return whether the terms of the model, fitted to all rows, leave about as little as a line to the others."""
    try:
        residuals = fit_calibration_model(points, choice).residuals
    except CollinearError:
        return False
    return float(np.sqrt(np.nanmean((residuals / reading_ranges(points)) ** 2))) < CLEAR_RATIO * misfit


def reading_ranges(points: CalibrationPoints) -> Array:
    """Return the range (c,) of the readings of each channel."""
    spread = np.ptp(points.channels[points.weight > 0], axis=0)
    return np.where(spread > 0.0, spread, 1.0)


def centered_rows(points: CalibrationPoints, columns: Array, rows: Mask) -> tuple[Array, Array, Index]:
    """Return columns and readings over their ranges of rows (m,), less their means in each load series, and these."""
    series = points.load_series[rows]
    if not len(series):
        return columns[rows], points.channels[rows], series
    readings = points.channels[rows] / reading_ranges(points)
    return subtract_block_means(columns[rows], series), subtract_block_means(readings, series), series


def describe_contradicted_series(
    model: CalibrationModel, points: CalibrationPoints, left_out: Iterable[Mask]
) -> tuple[SuspectLoadSeries, ...]:
    """Return the deviating channels of each load series, of rows (m,), and the mistake, by a model without them."""
    return tuple(suspect for rows in left_out for suspect in _deviating_channels(model, points, rows))


def _deviating_channels(model: CalibrationModel, points: CalibrationPoints, rows: Mask) -> list[SuspectLoadSeries]:
    change, expected = subtract_mean(points.channels[rows]), subtract_mean(model.readings(points.loads[rows]))
    power = np.maximum(np.sum(expected**2, axis=0), np.finfo(float).tiny)
    gain = np.sum(change * expected, axis=0) / power
    sigma = np.sqrt(np.mean((change - gain * expected) ** 2, axis=0) / power)
    largest = np.max(np.abs(change - expected), axis=0) / reading_ranges(points)
    deviating = np.flatnonzero(largest > min(MIN_ERROR_SHARE, float(largest.max())))
    words, cause = describe_rows(points, rows), series_cause(model, points, rows)
    names = points.channel_names
    return [
        SuspectLoadSeries(words, names[c], float(gain[c]), float(sigma[c]), "", cause=cause)
        for c in (deviating if len(deviating) else [int(np.argmax(largest))])
    ]


def describe_rows(points: CalibrationPoints, rows: Mask) -> str:
    """Return some rows (m,) of one run in words, as a load series."""
    at = np.flatnonzero(rows)
    begin = int(np.flatnonzero(points.run == points.run[at[0]])[0])
    return describe_load_series(at - begin, points.run_names[points.run[at[0]]], points.components, points.x[begin:])
