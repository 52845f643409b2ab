"""Noise of the channel readings and of the load readings, separated in the residuals of a calibration.

The noise of a load reading appears only where that load is applied: there every channel i has C_ij sigma_j in addition:

    E e_i^2 = S_ii + sum_j (C_ij sigma_j)^2 [load j applied],        S_ii, sigma_j^2 >= 0,

solved as a regression of the squared residuals with weights from their own expectation (variance components: Searle,
Casella and McCulloch, Variance Components, 1992, chapter 8).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals import distributions as stats

Array = NDArray[np.float64]

APPLIED_SHARE = 1e-2
"""Share of the calibrated range above which a load counts as applied: above load noise, below the first load step."""
REWEIGHTING_ITERATIONS = 4
"""The weights depend on the result; they are settled to less than its own uncertainty after a few iterations."""
MIN_OWN_SHARE = 0.05
"""Floor of a channel's own share of its residual variance: no channel is free of noise, and weights stay bounded."""
LOAD_NOISE_P_VALUE = 0.01
"""P-value below which residuals tell noise of the loads from noise of the channels."""
MIN_EIGENVALUE_RATIO = 1e-3
"""Floor of the eigenvalues of the correlation matrix over the largest, so that it can be inverted as a weight."""


@dataclass(frozen=True)
class CalibrationNoise:
    """Covariance (c, c) [V2] of the readings of a row; sigma (k,) of load readings in units of the calibrated range."""

    reading_covariance: Array = field(metadata={"stored_as": "readings"})
    load_sigma: Array = field(metadata={"stored_as": "loads"})


def estimate_calibration_noise(residuals: Array, x: Array, C: Array, covariance: Array) -> CalibrationNoise:
    """Estimate both kinds of noise from residuals (m, c) [V] at loads x (m, k) in units of the calibrated range.

    C (c, k) [V] is the linear part of the model; `covariance` (c, c) [V2] is that of the residuals of a row.
    """
    from scipy.optimize import nnls

    m, c = residuals.shape
    k = x.shape[1]
    scale = np.diag(covariance)
    applied = (np.abs(x) > APPLIED_SHARE).astype(float)
    # Rescaled to unit mean: the degrees of freedom of the fit make residuals smaller than the noise.
    squares = residuals**2 / scale * (scale * m / np.maximum(np.sum(residuals**2, axis=0), np.finfo(float).tiny))
    channel_columns = np.tile(np.eye(c), (m, 1))
    load_columns = (applied[:, None, :] * (C**2 / scale[:, None])[None]).reshape(m * c, k)
    size = np.maximum(load_columns.max(axis=0), np.finfo(float).tiny)
    columns = np.hstack([channel_columns, load_columns / size])
    weight = np.ones(m * c)
    variance_components = np.zeros(c + k)
    for _ in range(REWEIGHTING_ITERATIONS):
        variance_components = nnls(columns * weight[:, None], squares.reshape(-1) * weight)[0]
        weight = 1.0 / np.maximum(columns @ variance_components, MIN_OWN_SHARE)
    if not _loads_are_noisy(squares, (columns @ variance_components).reshape(m, c), k):
        variance_components = np.r_[squares.mean(axis=0), np.zeros(k)]
    loads = np.sqrt(variance_components[c:] / size)
    share = np.maximum(variance_components[:c], MIN_OWN_SHARE)
    correlation = covariance / np.sqrt(scale[:, None] * scale)
    own_correlation = correlation * np.sqrt(share[:, None] * share)
    # The noise of a load reading is common to all channels: its part of the correlation is subtracted.
    common = np.einsum("j,ij,lj->il", applied.mean(axis=0) * loads**2, C, C) / np.sqrt(scale[:, None] * scale)
    own_part = np.where(np.eye(c, dtype=bool), own_correlation, correlation - common)
    return CalibrationNoise(_nearest_positive_definite(own_part) * np.sqrt(scale[:, None] * scale), loads)


def row_variance(residuals: Array, x: Array) -> Array:
    """Return the variance (m,) of each row of one channel: its own, and that of the loads x (m, k) applied in the row.

    The readings of a channel that one load alone moves do not tell the two apart by other channels. Units are those of
    the squared residuals (m,).
    """
    from scipy.optimize import nnls

    columns = np.column_stack([np.ones(len(x)), np.abs(x) > APPLIED_SHARE])
    mean = float(np.mean(residuals**2)) or 1.0
    variance = np.ones(len(x))
    for _ in range(REWEIGHTING_ITERATIONS):
        weighted = columns / variance[:, None]
        variance = np.maximum(columns @ nnls(weighted, residuals**2 / mean / variance)[0], MIN_OWN_SHARE)
    return np.asarray(mean * variance)


def _loads_are_noisy(squares: Array, variance: Array, loads: int) -> bool:
    """Whether noise of the loads explains squared residuals (m, c) significantly better than noise of the channels.

    Otherwise all noise is attributed to the channels, so that loads computed from new readings get no sigma that is too
    small. Likelihood ratio of normal residuals; what a load causes in all channels of a row is counted once.
    """
    explained = np.maximum(variance, MIN_OWN_SHARE)
    alone = np.broadcast_to(squares.mean(axis=0), squares.shape)
    deviances = [np.sum(np.mean(np.log(v) + squares / v, axis=1)) for v in (alone, explained)]
    return bool(stats.chi2.sf(max(deviances[0] - deviances[1], 0.0), loads) < LOAD_NOISE_P_VALUE)


def _nearest_positive_definite(matrix: Array) -> Array:
    """Raise the eigenvalues of a symmetric matrix to at least MIN_EIGENVALUE_RATIO times the largest."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.maximum(values, MIN_EIGENVALUE_RATIO * values[-1])) @ vectors.T)
