"""Load points of a static run, and the noise of a row from differences along the load series.

Gasser, Sroka and Jennen-Steinmetz, Biometrika 73 (1986) 625-633: a straight line through the two neighbours of a
point predicts it but for noise, whatever smooth misfit the model has (hysteresis, drift, curvature). Nothing is asked
of the calibration's own residual, which would hide a wrong model in a large noise.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.signals.row_noise import row_noise
from balance_cli.signals.run_samples import read_samples, run_error
from balance_cli.signals.run_spectrum import NoisePart, StaticPoints

Array = NDArray[np.float64]

MIN_DIRECTION_COSINE = 0.95
OUTLIER_PROBABILITY = 1e-3
VARIANCE_FLOOR_SHARE = 1e-9


def static_points(run: Run, channel_names: Sequence[str]) -> StaticPoints:
    """Rows of a static run in the order of loading, with the noise covariance of `channels - C0 loads`.

    The rows are first freed of what is linear in the loads, then differenced along the ramps of the load series,
    then freed of the differences that a quadratic or cubic misfit leaves. UserError: no loads, too few rows in order.
    """
    channels, loads = read_samples(run, channel_names)
    differences = second_differences(loads)
    c = len(channel_names)
    if len(differences) < c + 2:
        raise run_error(
            run, f"only {len(differences)} rows lie within a ramp of the loading", "Apply the loads in steps"
        )
    covariance, dof = difference_covariance(channels, loads, differences)
    parts = _noise_parts(channels, loads, differences, covariance, dof)
    names = tuple(channel_names)
    return StaticPoints(run.name, run.trim or "", names, channels, loads, covariance, dof, noise_parts=parts)


def second_differences(loads: Array) -> Array:
    """Operator (t, m) that takes from each row within a ramp what its two neighbours predict by a straight line.

    loads (m, 6). Each difference is scaled to the variance of one row. A triple counts where the load moves on in one
    direction and did so before it: the first row after a reversal may lie across a jump of the hysteresis.
    """
    size = np.ptp(loads, axis=0)
    steps = np.diff(loads / np.where(size > 0, size, 1.0), axis=0)
    length = np.linalg.norm(steps, axis=1)
    along = np.sum(steps[:-1] * steps[1:], axis=1) > MIN_DIRECTION_COSINE * length[:-1] * length[1:]
    moving = (length[:-1] > 1e-3) & (length[1:] > 1e-3) & along
    same_direction_before = np.concatenate([[False], moving[:-1]])
    middle = np.flatnonzero(moving & same_direction_before) + 1
    share = length[middle - 1] / (length[middle - 1] + length[middle])
    operator = np.zeros((len(middle), len(loads)))
    rows = np.arange(len(middle))
    operator[rows, middle] = 1.0
    operator[rows, middle - 1] = share - 1.0
    operator[rows, middle + 1] = -share
    return np.asarray(operator / np.linalg.norm(operator, axis=1)[:, None], float)


def _noise_parts(
    channels: Array, loads: Array, operator: Array, covariance: Array, dof: float
) -> tuple[NoisePart, ...]:
    """What the noise covariance of each row is made up of."""
    B = _difference_operator(loads, operator)
    variance = np.sum(B**2, axis=1)
    weights = _robust_weights(B @ channels, covariance, variance, dof, channels.shape[1])
    return row_noise(channels, loads, B, weights, covariance, dof)


def _difference_operator(loads: Array, operator: Array) -> Array:
    """B (t, m): differences of what is not linear in the loads, less what their squares and cubes explain."""
    linear, nonlinear_columns = _regressors(loads)
    return _subtract_projection(operator @ nonlinear_columns, _subtract_projection(linear, operator.T).T)


def difference_covariance(rows: Array, loads: Array, operator: Array) -> tuple[Array, float]:
    """Noise covariance (c, c) of rows (m, c) from differences of their regression residuals, and its dof.

    The differences are d = B y, B = M2 D M1: M1 projects on what is not linear in the loads, D is the operator, M2
    projects on what differences of squares and cubes of the loads do not explain. Their weighted squares have the
    expectation tr(A) Sigma and tr(A)^2 / tr(A^2) degrees of freedom, A = B' W B. The weights W take the force out of
    rows that jump.
    """
    differenced = _difference_operator(loads, operator)
    d = differenced @ rows
    c = rows.shape[1]
    weights = _initial_weights(d)
    floor = np.diag((VARIANCE_FLOOR_SHARE * np.maximum(np.ptp(rows, axis=0), 1e-300)) ** 2)
    gram = differenced @ differenced.T
    for _ in range(6):
        weighted = weights[:, None] * gram
        trace = np.trace(weighted)
        covariance = (d.T * weights) @ d / trace + floor
        dof = float(trace**2 / np.sum(weighted * weighted.T))
        weights = _robust_weights(d, covariance, np.diagonal(gram), dof, c)
    return covariance, dof


def _regressors(loads: Array) -> tuple[Array, Array]:
    """Columns (m, 7) of 1 and each load, and (m, 12) of their squares and cubes, about the mean load."""
    size = np.ptp(loads, axis=0)
    x = (loads - loads.mean(axis=0)) / np.where(size > 0, size, 1.0)
    return np.hstack([np.ones((len(x), 1)), x]), np.hstack([x**2, x**3])


def _subtract_projection(columns: Array, values: Array) -> Array:
    """Values (m, ...) less their projection on the columns (m, q)."""
    U, s, _ = np.linalg.svd(columns, full_matrices=False)
    Q = U[:, s > 1e-6 * s[0]]
    return np.asarray(values - Q @ (Q.T @ values))


def _initial_weights(differences: Array) -> Array:
    """Weights from each channel's median: a difference beyond 6 robust standard deviations is reined in."""
    scale = 1.4826 * np.median(np.abs(differences), axis=0)
    largest = np.max(np.abs(differences) / np.maximum(scale, 1e-300), axis=1)
    return np.asarray(np.minimum(1.0, (6.0 / np.maximum(largest, 1e-300)) ** 2), float)


def _robust_weights(differences: Array, covariance: Array, variance: Array, dof: float, c: int) -> Array:
    """Weights by Mahalanobis distance against Hotelling's distribution; the farther off, the less a difference adds."""
    from scipy.stats import f

    distance = np.sum(differences * np.linalg.solve(covariance, differences.T).T, axis=1) / np.maximum(variance, 1e-12)
    free = max(dof - c + 1.0, 1.0)
    bound = c * dof / free * float(f.isf(OUTLIER_PROBABILITY, c, free))
    return np.asarray(np.minimum(1.0, bound / np.maximum(distance, 1e-300)) ** 2, float)
