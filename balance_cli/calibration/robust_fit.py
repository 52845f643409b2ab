"""Robust fit of the loads with a zero for each load series, and the rows that stand out from it.

The fit has the loads and, where the rows suffice, their absolute values and squares, because curvature is no fault of a
row. It begins with least absolute deviations and ends with Tukey's biweight (Maronna, Martin, Yohai and
Salibian-Barrera, Robust Statistics, 2nd ed., 2019, chapter 5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.block_zeros import BlockZeros
from balance_cli.calibration.robust_scale import growth_without_load
from balance_cli.signals import distributions as stats

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

OUTLIER_SIGNIFICANCE_LEVEL = 1e-3
"""Probability of calling any good row an outlier."""
CANDIDATE_LIMIT_FACTOR = 1.3
"""Factor on the limit of the normal distribution: the robust scale is itself known to a few per cent only."""
LAD_ITERATIONS, BIWEIGHT_ITERATIONS = 15, 15
"""Iterations of each stage; the weights then change less than the scale is known."""
BIWEIGHT_LIMIT = 4.685
"""Robust standard deviations from which a row has no weight: 95 % efficiency for normal errors."""
ROWS_PER_COEFFICIENT = 3
"""Rows for each coefficient, so that a robust fit of curvature has rows to spare."""
MAX_CANDIDATE_SHARE = 0.1
"""Share of the rows that can stand out; of more rows the model is wrong, and not the rows."""
MAX_SERIES_SHARE = 0.3
"""Share of the rows of a load series that can stand out; with more of them the series is suspect as a whole."""
MIN_CANDIDATES = 2
"""Rows that can stand out in any number of rows: two that are exchanged."""
MIN_SINGULAR = 1e-10
"""Singular value over the largest from which columns are told apart: rounding leaves 1e-15 or so."""
SCALE_FLOOR = 1e-9
"""Floor of the scale over the range of a channel: computed readings have no noise."""


@dataclass(frozen=True)
class RobustFit:
    """Rows (m,) that stand out from a robust fit, and the robust standard deviation (c,) of each channel's errors.

    `deviates` (m,): these, and all rows of load series of which too many are beyond chance to be outliers.
    """

    stands_out: Mask
    scale: Array
    deviates: Mask


def fit_robustly(x: Array, channels: Array, block: Index) -> RobustFit:
    """Fit `channels` (m, c) robustly to loads x (m, k), with a zero for each `block` (m,).

    Two fits are made, with and without curvature: a single row of the other sign would determine a curvature by itself.
    The scale is that with curvature.
    """
    stands_out, deviates, scale = np.zeros(len(x), bool), np.zeros(len(x), bool), np.zeros(channels.shape[1])
    for columns in _column_sets(x, int(block.max()) + 1):
        ratio, scale = _robust_ratio(columns, channels, block)
        ratio = ratio / growth_without_load(ratio, x, block, np.ones(len(x), bool))
        limit = float(CANDIDATE_LIMIT_FACTOR * stats.norm.isf(0.5 * OUTLIER_SIGNIFICANCE_LEVEL / channels.size))
        stands_out |= _standing_out(ratio, block, limit)
        deviates |= _deviating_series(ratio, block, limit)
    return RobustFit(stands_out, scale, stands_out | deviates)


def _deviating_series(ratio: Array, block: Index, limit: float) -> Mask:
    """Rows (m,) of the load series that have too many rows beyond a limit; none where these are too many rows."""
    deviates = np.zeros(len(ratio), bool)
    for name in np.unique(block):
        rows = block == name
        deviates |= rows & (np.count_nonzero((ratio > limit) & rows) > _most_outliers(rows))
    return deviates if np.count_nonzero(deviates) <= MAX_CANDIDATE_SHARE * len(ratio) else np.zeros_like(deviates)


def _most_outliers(rows: Mask) -> float:
    return max(MIN_CANDIDATES, MAX_SERIES_SHARE * np.count_nonzero(rows))


def _standing_out(ratio: Array, block: Index, limit: float) -> Mask:
    """Rows (m,) whose ratio of error and scale is beyond a limit, where these are few in their load series."""
    stands_out = ratio > limit
    for name in np.unique(block):
        rows = block == name
        if np.count_nonzero(stands_out & rows) > _most_outliers(rows):
            stands_out[rows] = False
    most = int(max(MIN_CANDIDATES, MAX_CANDIDATE_SHARE * len(ratio)))
    largest = np.argsort(np.where(stands_out, -ratio, 0.0), kind="stable")[:most]
    return np.asarray(stands_out & np.isin(np.arange(len(ratio)), largest))


def _robust_ratio(columns: Array, Y: Array, block: Index) -> tuple[Array, Array]:
    """Largest error of each row (m,) over the robust scale of its channel, and these scales (c,)."""
    m, weight = len(Y), np.ones(len(Y))
    zeros = BlockZeros.from_blocks(block, weight)
    basis = _basis(columns, zeros)
    values = np.hstack([basis, Y])
    freedom = np.sqrt(m / _dof(columns, block))
    least = SCALE_FLOOR * np.maximum(np.ptp(Y, axis=0), 1e-300)
    ratio, scale = np.zeros(Y.shape), np.zeros(Y.shape[1])
    for iteration in range(LAD_ITERATIONS + BIWEIGHT_ITERATIONS):
        errors = np.abs(_weighted_errors(values, basis.shape[1], zeros.with_weight(weight)))
        scale = np.maximum(1.4826 * _median(errors) * freedom, least)
        ratio = errors / scale
        size = np.sqrt(np.mean(ratio**2, axis=1))
        if iteration < LAD_ITERATIONS:
            weight = 1.0 / np.maximum(size, 0.1)
        else:
            # No row is without any weight: a load series needs its zero.
            weight = np.maximum(1.0 - (size / BIWEIGHT_LIMIT) ** 2, 0.0) ** 2 + 1e-6
    return np.asarray(np.max(ratio, axis=1)), scale


def _median(values: Array) -> Array:
    """Median (c,) of finite values (m, c): `np.median` takes longer than the fit of an iteration for so few rows."""
    middle = np.sort(values, axis=0)[[(len(values) - 1) // 2, len(values) // 2]]
    return np.asarray(np.mean(middle, axis=0))


def _column_sets(x: Array, zeros: int) -> list[Array]:
    """The loads alone and, where the rows suffice, with their squares, and with their absolute values too."""
    for curved in (np.hstack([x, np.abs(x), x**2]), np.hstack([x, x**2])):
        if len(x) >= ROWS_PER_COEFFICIENT * (curved.shape[1] + zeros):
            return [x, curved]
    return [x]


def _dof(columns: Array, block: Index) -> int:
    return max(len(columns) - int(columns.shape[1]) - int(block.max()) - 1, 1)


def _basis(columns: Array, zeros: BlockZeros) -> Array:
    """Orthonormal columns (m, r) that span the columns (m, k) within the blocks: products of weighted ones are regular.

    Absolute values are the loads themselves where all are of one sign.
    """
    U, s, _ = np.linalg.svd(zeros.subtract_means(columns), full_matrices=False)
    return np.asarray(U[:, s > MIN_SINGULAR * s[0]]) if s[0] > 0.0 else columns[:, :0]


def _weighted_errors(values: Array, count: int, zeros: BlockZeros) -> Array:
    """Errors (m, c) of a weighted fit with a zero for each block; `values` (m, r + c): basis, channels."""
    weighted = zeros.subtract_means(values)
    A, y = weighted[:, :count], weighted[:, count:]
    try:
        coefficients = np.linalg.solve(A.T @ A, A.T @ y)
    except np.linalg.LinAlgError:  # rows of hardly any weight alone tell a column
        coefficients = np.linalg.lstsq(A, y, rcond=MIN_SINGULAR)[0]
    left = values[:, count:] - values[:, :count] @ coefficients
    return np.asarray(left - zeros.means(left * zeros.root[:, None])[zeros.place])
