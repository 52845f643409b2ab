"""Consecutive rows that all others contradict, where they are no load series of their own, or half of all series.

A schedule by chance without a column `series` is one load series, so that no series can be left out. What goes wrong in
it (a cable, a weight of the other sign, a supply) begins at some row, and often ends at another one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.block_zeros import subtract_mean
from balance_cli.calibration.contradicted_series import (
    CLEAR_RATIO,
    MIN_DOF,
    MIN_ERROR_RATIO,
    MIN_ERROR_SHARE,
    MIN_MISFIT,
    MIN_SERIES,
    centered_rows,
    describe_rows,
    is_explained,
    reading_ranges,
)
from balance_cli.calibration.fit import CalibrationPoints, fit_calibration_model, refit_terms
from balance_cli.calibration.least_squares import CollinearError
from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.series_causes import series_cause
from balance_cli.calibration.term_choice import LINEAR_TERMS, TermChoice
from balance_cli.calibration.terms import all_terms, linear_terms, term_values

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

GRID = 40
"""Places at which a block may begin or end at first, for 600 linear fits; the rows are told afterwards."""
MIN_ROWS = 4
"""Rows with large errors in a block: fewer are outliers, which are told one by one."""
MIN_WRONG_SHARE = 0.4
"""Share of the rows of a block that have large errors: of loads by chance some are small."""
MAX_EXCLUDED_SHARE = 1.0 / 3.0
"""Share of the rows up to which a block is left out: two thirds agree. Of more, nothing tells which part is right."""
MAX_SHARE = 0.55
"""Share of the rows of the largest blocks and halves that are tried: half, and what the grid misses."""
SAME_MISFIT = 1.5
"""Misfit over the least one up to which a shorter block does as well."""
EXPLAINED = 0.5 * MIN_MISFIT
"""What the terms of the model may leave of all rows: a wrong block, 4 of 80 rows, leaves more."""
SERIES_MISFIT = 0.3 * MIN_MISFIT
"""What a line leaves where series were found that the others contradict: they may be a part of what is wrong."""
MAX_HALVES = 1000
"""Halves of the load series that are tried: all those of twelve; of more the first and the last ones."""
UNDECIDED = "these rows and the others contradict each other, and nothing tells which are right"
"""How a note ends on rows that are not excluded."""


@dataclass(frozen=True)
class ContradictedBlock:
    """Rows (m,) that the others contradict; `is_minority`: these are so many that they are right."""

    rows: Mask
    is_minority: bool


def contradicted_block(
    points: CalibrationPoints, choice: TermChoice, series: Sequence[Mask] = ()
) -> ContradictedBlock | None:
    """Return consecutive rows, or half of the load series, without which the others agree far better; None without.

    None also where terms of the model explain them, or where the others agree about as well without the rows (m,) of
    some `series`.
    """
    k = len(points.components)
    for terms in (linear_terms(k), (*linear_terms(k), *(term for term in all_terms(k) if term.is_quadratic))):
        columns = term_values(terms, points.x)
        whole = _misfit(points, columns, (points.weight > 0) & ~np.any([np.zeros(len(columns), bool), *series], axis=0))
        if whole < (SERIES_MISFIT if series else MIN_MISFIT) or not np.isfinite(whole):
            return None
        rows = _best_rows(points, columns, whole)
        if rows is not None:
            left = _misfit(points, columns, (points.weight > 0) & ~rows)
            if is_explained(points, choice, max(left, EXPLAINED / CLEAR_RATIO)):
                return None
            share = np.count_nonzero(rows) / np.count_nonzero(points.weight > 0)
            return ContradictedBlock(rows, bool(share <= MAX_EXCLUDED_SHARE))
    return None


def contradiction_note(points: CalibrationPoints, model: CalibrationModel, rows: Mask) -> str:
    """Say what rows (m,) contradict, and why, where nothing tells whether they or the others are right."""
    try:
        others = refit_terms(points.exclude_rows(rows), model).model
    except CollinearError:  # some term is told by these rows alone
        others = fit_calibration_model(points.exclude_rows(rows), LINEAR_TERMS).model
    cause = series_cause(others, points, rows) or _largest_gain(others, points, rows)
    return f"{_describe(points, rows)}: {cause}: {UNDECIDED}"


def _describe(points: CalibrationPoints, rows: Mask) -> str:
    """Name rows (m,) that are consecutive, or whole load series."""
    at = np.flatnonzero(points.weight > 0)
    places = np.flatnonzero(rows[at])
    if places[-1] - places[0] + 1 == len(places):
        return describe_rows(points, rows)
    names = np.unique(points.load_series[rows]).tolist()
    words = [describe_rows(points, rows & (points.load_series == name)) for name in names]
    return f"{len(words)} of {len(np.unique(points.load_series[at]))} load series, {'; '.join(words)}"


def _largest_gain(model: CalibrationModel, points: CalibrationPoints, rows: Mask) -> str:
    """Say which channel differs most in rows (m,) from what a model of the others predicts."""
    change, expected = subtract_mean(points.channels[rows]), subtract_mean(model.readings(points.loads[rows]))
    error = np.sqrt(np.mean((change - expected) ** 2, axis=0)) / reading_ranges(points)
    c = int(np.argmax(error))
    gain = float(np.sum(change[:, c] * expected[:, c]) / max(float(np.sum(expected[:, c] ** 2)), np.finfo(float).tiny))
    return f"{points.channel_names[c]} changes {gain:.3g} times as much as the others predict"


def _best_rows(points: CalibrationPoints, columns: Array, whole: float) -> Mask | None:
    """The fewest rows (m,) without which the misfit is about the least, and clearly less than the `whole` one."""
    used = points.weight > 0
    blocks = list(_blocks(points))
    misfits = np.array([_misfit(points, columns, used & ~block) for block in blocks])
    if blocks and misfits.min() * CLEAR_RATIO < whole:
        near = np.flatnonzero(misfits <= SAME_MISFIT * misfits.min())
        shortest = min(near.tolist(), key=lambda place: int(np.count_nonzero(blocks[place])))
        rows = _wrong_rows(points, columns, blocks[shortest], misfits.min())
        if rows is not None and _misfit(points, columns, used & ~rows) * CLEAR_RATIO < whole:
            return rows
    halves = list(_halves(points))
    misfits = np.array([_misfit(points, columns, used & ~half) for half in halves])
    if halves and misfits.min() * CLEAR_RATIO < whole:
        return halves[int(np.argmin(misfits))]
    return None


def _blocks(points: CalibrationPoints) -> Iterator[Mask]:
    """Yield consecutive rows (m,) of one load series, of which others remain, by their begin and end on a grid."""
    used = points.weight > 0
    step = max(1, round(np.count_nonzero(used) / GRID))
    for name in np.unique(points.load_series[used]).tolist():
        at = np.flatnonzero(used & (points.load_series == name))
        places = [*range(0, len(at), step), len(at)]
        for begin, end in combinations(places, 2):
            if MIN_ROWS <= end - begin <= MAX_SHARE * len(at):
                block = np.zeros(len(used), bool)
                block[at[begin:end]] = True
                yield block


def _halves(points: CalibrationPoints) -> Iterator[Mask]:
    """Yield the rows (m,) of the first half of the load series, or about it, and of each half of few series."""
    used = points.weight > 0
    names = np.unique(points.load_series[used]).tolist()
    if len(names) < MIN_SERIES:
        return
    for count in range(1, len(names)):
        first = np.isin(points.load_series, names[:count]) & used
        for half in (first, used & ~first):
            if MAX_EXCLUDED_SHARE < np.count_nonzero(half) / np.count_nonzero(used) <= MAX_SHARE:
                yield half
    if comb(len(names), len(names) // 2) <= MAX_HALVES:
        for some in combinations(names, len(names) // 2):
            yield np.isin(points.load_series, some) & used


def _misfit(points: CalibrationPoints, columns: Array, rows: Mask) -> float:
    """What a fit to some rows (m,) leaves of their readings over the ranges, rms; inf where they do not tell it."""
    x, y, series = centered_rows(points, columns, rows)
    dof = len(x) - len(np.unique(series)) - x.shape[1]
    if dof < max(MIN_DOF, x.shape[1]):
        return float("inf")
    solution, _, rank, _ = np.linalg.lstsq(x, y, rcond=1e-6)
    return float(np.sqrt(np.sum((y - x @ solution) ** 2) / (dof * y.shape[1]))) if rank == x.shape[1] else float("inf")


def _wrong_rows(points: CalibrationPoints, columns: Array, block: Mask, misfit: float) -> Mask | None:
    """The rows (m,) from the first to the last with a large error in and beside a block (m,); None where few have."""
    used = points.weight > 0
    at, inside = np.flatnonzero(used), np.flatnonzero(block[used])
    step = len(at) // GRID + 1
    tried = np.zeros(len(used), bool)
    tried[at[max(inside[0] - step, 0) : inside[-1] + step + 1]] = True
    x, y, _ = centered_rows(points, columns, used & ~tried)
    if len(x) < max(MIN_DOF, x.shape[1]):
        return None
    own = columns[tried] - columns[used & ~tried].mean(axis=0)
    errors = _errors(points, columns, tried, np.asarray(np.linalg.lstsq(x, y, rcond=1e-6)[0]))
    sigma = misfit * np.sqrt(1.0 + np.sum(own * np.linalg.lstsq(x.T @ x, own.T, rcond=None)[0].T, axis=1))
    largest = np.max(np.abs(errors), axis=1)
    wrong = np.flatnonzero((largest > MIN_ERROR_SHARE) & (largest > MIN_ERROR_RATIO * sigma))
    if len(wrong) < MIN_ROWS or len(wrong) < MIN_WRONG_SHARE * (wrong[-1] - wrong[0] + 1):
        return None
    shift = np.max(np.abs(errors[wrong] - np.median(errors[wrong], axis=0)), axis=1)
    if np.mean(shift > MIN_ERROR_SHARE) < MIN_WRONG_SHARE:  # only the zero moved
        return None
    rows = np.zeros(len(used), bool)
    rows[np.flatnonzero(tried)[wrong[0] : wrong[-1] + 1]] = True
    return rows & used


def _errors(points: CalibrationPoints, columns: Array, tried: Mask, coefficients: Array) -> Array:
    """Errors (r, c) of the tried rows (m,) over the ranges, less the zeros of their series by the other rows of these.

    Of series without other rows the median error is the zero.
    """
    errors = points.channels / reading_ranges(points) - columns @ coefficients
    for name in np.unique(points.load_series[tried]).tolist():
        series = (points.load_series == name) & (points.weight > 0)
        others = series & ~tried
        errors[series] -= errors[others].mean(axis=0) if others.any() else np.median(errors[series], axis=0)
    return np.asarray(errors[tried])
