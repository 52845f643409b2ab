"""Load points of a static run, and the noise of a row from differences along the ramps of the loading.

Gasser, Sroka and Jennen-Steinmetz, Biometrika 73 (1986) 625-633: a straight line through the two neighbors of a point
predicts it up to noise, whatever smooth misfit the model has (hysteresis, drift, nonlinearity). The residual of the
calibration is not used, because it would attribute a wrong model to a large noise.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.signals.row_noise import OWN_VARIANCE_SHARE, row_noise
from balance_cli.signals.run_samples import read_samples, run_error
from balance_cli.signals.run_spectrum import NoisePart, StaticPoints

Array = NDArray[np.float64]

MIN_DIRECTION_COSINE = 0.95
"""Cosine between consecutive load steps (18 deg) from which they count as one direction of loading."""
MIN_STEP = 1e-3
"""Length of a load step, over the range of the loads, below which the load counts as constant."""
OUTLIER_PROBABILITY = 1e-3
"""Probability of a larger Mahalanobis distance from which the weight of a difference is reduced."""
VARIANCE_FLOOR_SHARE = 1e-9
"""Floor of the noise over the range of a channel, so that the covariance of computed readings can be inverted."""
REWEIGHTING_ITERATIONS = 6
"""Iterations of covariance and robust weights; the changes are then far below the uncertainty of the covariance."""
ROBUST_LIMIT = 6.0
"""Robust standard deviations beyond which the initial weight of a difference is reduced."""
COLLINEARITY_RATIO = 1e-6
"""Singular values of the regressors, over the largest, that count as zero."""
FEW_ROWS = 8
"""Rows over the differences that are needed, which nearly always have as many: half of the rows of a ramp do."""


def static_points(run: Run, channel_names: Sequence[str]) -> StaticPoints:
    """Rows of a static run in the order of loading, with the noise covariance of `channels - C0 loads`.

    First the linear dependence on the loads is eliminated, then the rows are differenced along the ramps of the
    loading, then the differences of a quadratic or cubic misfit are eliminated. Where the ramps are short (zero, half,
    full), the differences of rows with equal loads count too; what hysteresis they contain counts as noise.

    Raises UserError where there are no loads, or too few rows within a ramp or at equal loads.
    """
    if not channel_names:
        raise run_error(run, "none of its channels can be used", "Repair the channels, or leave the run out")
    channels, loads = read_samples(run, channel_names)
    if not np.any(np.ptp(loads, axis=0)):
        raise run_error(run, "its loads do not change", "Apply loads in steps, up and down", "loads")
    differences, needed = second_differences(loads), len(channel_names) + 2
    count = _independent_differences(loads, differences, needed)
    if count < needed:
        differences = np.vstack([differences, repeated_differences(loads)])
        count = _independent_differences(loads, differences, needed)
    if count < needed:
        fault = f"only {count} rows within a ramp of the loading or at repeated loads show its noise"
        raise run_error(run, fault, "Apply the loads in steps, up and down")
    covariance, dof = difference_covariance(channels, loads, differences)
    parts = _noise_parts(channels, loads, differences, covariance, dof)
    names, labels = tuple(channel_names), run.series_labels
    series = None if labels is None else np.unique(labels, return_inverse=True)[1].reshape(-1)
    return StaticPoints(
        run.name, run.trim or "", names, channels, loads, covariance, dof, noise_parts=parts, series=series
    )


def _independent_differences(loads: Array, operator: Array, needed: int) -> int:
    """Differences along the ramps that no linear, quadratic or cubic function of the loads explains.

    Where some of many rows have as many as are needed the count is theirs: all rows of a long run would take minutes.
    """
    if not len(operator):
        return 0
    B, count = _difference_operator(loads, operator), 0
    for rows in (B[:: len(B) // (FEW_ROWS * needed) + 1], B):
        count = int(np.count_nonzero(np.linalg.svd(rows, compute_uv=False) > COLLINEARITY_RATIO))
        if count >= needed or len(rows) == len(B):
            break
    return count


def second_differences(loads: Array) -> Array:
    """Operator (t, m) that subtracts from each row within a ramp its linear interpolation between the two neighbors.

    `loads` (m, 6). Each difference is scaled to the variance of one row. Three rows are used where the load changes in
    one direction and did so before: the first row after a reversal may lie beyond a jump of the hysteresis.
    """
    size = np.ptp(loads, axis=0)
    steps = np.diff(loads / np.where(size > 0, size, 1.0), axis=0)
    length = np.linalg.norm(steps, axis=1)
    along = np.sum(steps[:-1] * steps[1:], axis=1) > MIN_DIRECTION_COSINE * length[:-1] * length[1:]
    moving = (length[:-1] > MIN_STEP) & (length[1:] > MIN_STEP) & along
    same_direction_before = np.concatenate([[False], moving[:-1]])
    middle = np.flatnonzero(moving & same_direction_before) + 1
    share = length[middle - 1] / (length[middle - 1] + length[middle])
    operator = np.zeros((len(middle), len(loads)))
    rows = np.arange(len(middle))
    operator[rows, middle] = 1.0
    operator[rows, middle - 1] = share - 1.0
    operator[rows, middle + 1] = -share
    return np.asarray(operator / np.linalg.norm(operator, axis=1)[:, None], float)


def repeated_differences(loads: Array) -> Array:
    """Operator (t, m) that subtracts from each row the last row before it with the same loads, if there is one.

    `loads` (m, 6). Each difference is scaled to the variance of one row.
    """
    size = np.ptp(loads, axis=0)
    x = loads / np.where(size > 0, size, 1.0)
    equal = np.linalg.norm(x[:, None] - x[None, :], axis=2) < MIN_STEP
    pairs = [(i, np.flatnonzero(equal[i, :i])[-1]) for i in range(len(loads)) if equal[i, :i].any()]
    operator = np.zeros((len(pairs), len(loads)))
    for row, (later, earlier) in enumerate(pairs):
        operator[row, later], operator[row, earlier] = np.sqrt(0.5), -np.sqrt(0.5)
    return operator


def _noise_parts(
    channels: Array, loads: Array, operator: Array, covariance: Array, dof: float
) -> tuple[NoisePart, ...]:
    """Parts of the noise covariance of each row."""
    B = _difference_operator(loads, operator)
    variance = np.sum(B**2, axis=1)
    weights = _robust_weights(B @ channels, covariance, variance, dof, channels.shape[1])
    return row_noise(channels, loads, B, weights, covariance, dof)


def _difference_operator(loads: Array, operator: Array) -> Array:
    """B (t, m): differences of rows, with linear, quadratic and cubic functions of the loads eliminated.

    Differences of which nothing is left tell nothing of the noise and are omitted: the only one along a ramp of two
    steps to both sides is a cubic misfit, but for the last digits of its loads.
    """
    linear, nonlinear_columns = _regressors(loads)
    B = _subtract_projection(operator @ nonlinear_columns, _subtract_projection(linear, operator.T).T)
    return np.asarray(B[np.linalg.norm(B, axis=1) > MIN_STEP])


def difference_covariance(rows: Array, loads: Array, operator: Array) -> tuple[Array, float]:
    """Noise covariance (c, c) of rows (m, c) from differences of their regression residuals, and its dof.

    The differences are d = B y with B = M2 D M1, where D is the operator, M1 eliminates functions that are linear in
    the loads, and M2 the differences of squares and cubes of the loads. Their weighted squares have the expectation
    tr(A) Sigma and tr(A)^2 / tr(A^2) degrees of freedom, A = B' W B. The weights W reduce the influence of jumps.
    """
    differenced = _difference_operator(loads, operator)
    d = differenced @ rows
    c = rows.shape[1]
    weights = _initial_weights(d)
    floor = np.diag((VARIANCE_FLOOR_SHARE * np.maximum(np.ptp(rows, axis=0), 1e-300)) ** 2)
    gram = differenced @ differenced.T
    for _ in range(REWEIGHTING_ITERATIONS):
        weighted = weights[:, None] * gram
        trace = np.trace(weighted)
        covariance = (d.T * weights) @ d / trace + floor
        covariance[np.diag_indices(c)] *= 1.0 + OWN_VARIANCE_SHARE
        dof = float(trace**2 / np.sum(weighted * weighted.T))
        weights = _robust_weights(d, covariance, np.diagonal(gram), dof, c)
    return covariance, dof


def _regressors(loads: Array) -> tuple[Array, Array]:
    """Columns (m, 7) of 1 and each load, and (m, 12) of squares and cubes of the loads, about the mean load."""
    size = np.ptp(loads, axis=0)
    x = (loads - loads.mean(axis=0)) / np.where(size > 0, size, 1.0)
    return np.hstack([np.ones((len(x), 1)), x]), np.hstack([x**2, x**3])


def _subtract_projection(columns: Array, values: Array) -> Array:
    """Values (m, ...) less their projection on the columns (m, q)."""
    U, s, _ = np.linalg.svd(columns, full_matrices=False)
    Q = U[:, s > COLLINEARITY_RATIO * s[0]]
    return np.asarray(values - Q @ (Q.T @ values))


def _initial_weights(differences: Array) -> Array:
    """Weights from the median of each channel: reduced for differences beyond ROBUST_LIMIT."""
    scale = 1.4826 * np.median(np.abs(differences), axis=0)
    largest = np.max(np.abs(differences) / np.maximum(scale, 1e-300), axis=1)
    return np.asarray(np.minimum(1.0, (ROBUST_LIMIT / np.maximum(largest, 1e-300)) ** 2), float)


def _robust_weights(differences: Array, covariance: Array, variance: Array, dof: float, c: int) -> Array:
    """Weights from Mahalanobis distances: reduced beyond the OUTLIER_PROBABILITY point of Hotelling's distribution."""
    from balance_cli.signals.distributions import f

    distance = np.sum(differences * np.linalg.solve(covariance, differences.T).T, axis=1) / np.maximum(variance, 1e-12)
    free = max(dof - c + 1.0, 1.0)
    bound = c * dof / free * float(f.isf(OUTLIER_PROBABILITY, c, free))
    return np.asarray(np.minimum(1.0, bound / np.maximum(distance, 1e-300)) ** 2, float)
