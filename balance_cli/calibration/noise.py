"""Noise of the readings and noise of the load readings, told apart in the residuals of a calibration.

A load's reading is noisy only where that load hangs: there every channel that hears it shows C_j sigma_j more. So

    E e_i^2 = S_ii + sum_j (C_ij sigma_j)^2 [load j applied],        S_ii, sigma_j^2 >= 0,

a regression of the squares with weights from its own expectation (variance components: Searle, Casella and McCulloch,
Variance Components, 1992, chapter 8).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Of full range: a load that hangs.
APPLIED_SHARE = 1e-2
REWEIGHTING_ITERATIONS = 4
# Share of a channel's variance that is its own at least.
MIN_OWN_SHARE = 0.05


@dataclass(frozen=True)
class CalibrationNoise:
    """Covariance (c, c) [V2] of the readings of a row, and standard deviation (k,) of load readings over full range."""

    readings: Array
    loads: Array

    def row_sigma(self, x: Array, C: Array) -> Array:
        """Standard deviation (m, c) of the residuals at loads x (m, k) over full range, C (c, k) [V]."""
        applied = np.abs(x) > APPLIED_SHARE
        return np.asarray(np.sqrt(np.diag(self.readings) + (applied * self.loads**2) @ (C**2).T))


def estimate_calibration_noise(residuals: Array, x: Array, C: Array, covariance: Array) -> CalibrationNoise:
    """Tell them apart in residuals (m, c) at loads x (m, k), C (c, k) [V]; `covariance` (c, c) is that of a row."""
    from scipy.optimize import nnls

    m, c = residuals.shape
    k = x.shape[1]
    scale = np.diag(covariance)
    applied = (np.abs(x) > APPLIED_SHARE).astype(float)
    # Residuals are smaller than the noise by what the fit took.
    squares = residuals**2 / scale * (scale * m / np.maximum(np.sum(residuals**2, axis=0), np.finfo(float).tiny))
    own = np.tile(np.eye(c), (m, 1))
    of_loads = (applied[:, None, :] * (C**2 / scale[:, None])[None]).reshape(m * c, k)
    size = np.maximum(of_loads.max(axis=0), np.finfo(float).tiny)
    columns = np.hstack([own, of_loads / size])
    weight = np.ones(m * c)
    variance_components = np.zeros(c + k)
    for _ in range(REWEIGHTING_ITERATIONS):
        variance_components = nnls(columns * weight[:, None], squares.reshape(-1) * weight)[0]
        weight = 1.0 / np.maximum(columns @ variance_components, MIN_OWN_SHARE)
    loads = np.sqrt(variance_components[c:] / size)
    share = np.maximum(variance_components[:c], MIN_OWN_SHARE)
    correlation = covariance / np.sqrt(scale[:, None] * scale)
    own_correlation = correlation * np.sqrt(share[:, None] * share)
    # What the loads' noise makes alike in all channels is not the readings'.
    common = np.einsum("j,ij,lj->il", applied.mean(axis=0) * loads**2, C, C) / np.sqrt(scale[:, None] * scale)
    own_part = np.where(np.eye(c, dtype=bool), own_correlation, correlation - common)
    return CalibrationNoise(_nearest_positive_definite(own_part) * np.sqrt(scale[:, None] * scale), loads)


def _nearest_positive_definite(matrix: Array) -> Array:
    """The nearest matrix whose eigenvalues are all at least a share of the largest."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.maximum(values, 1e-3 * values[-1])) @ vectors.T)
