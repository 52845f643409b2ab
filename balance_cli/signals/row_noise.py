"""Noise of each row of a static run, with the noise of a load reading only where that load was applied.

Differences d (t, c) along the loading contain no functions that are linear in the loads, and so not the loads
themselves. Of the reading of load j they contain its noise n_j multiplied by the column c_j of C0. With the
operator B (t, m), and h_ij the sum of B_ir^2 over the rows r in which j was applied,

    cov d_i = (sum_r B_ir^2) Sigma + sum_j h_ij sigma_j^2 c_j c_j' .

Sigma and the six sigma_j are estimated together as variance components by expectation-maximization (Searle, Casella and
McCulloch, Variance Components, 1992, chapter 8). The noise of a load that was applied in all rows is part of Sigma.
Where Sigma would be known too poorly to be inverted it is diagonal, and the noise of each load a part of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.covariance_pooling import MIN_DOF_PER_SIGNAL
from balance_cli.signals.run_spectrum import NoisePart

Array = NDArray[np.float64]

OWN_VARIANCE_SHARE = 1e-12
"""Share of the variance that each channel has for itself: coarsely quantized channels may repeat each other exactly."""
EM_ITERATIONS = 60
"""Expectation-maximization converges linearly; the change is then below the standard errors of the components."""
ALWAYS_APPLIED_SHARE = 0.9
"""Share of the rows from which a load counts as always applied: fewer rows without it do not determine its noise."""
UNKNOWN_VARIANCE_FACTOR = 1e3
"""Standard error of an undetermined variance, in units of one that would be visible beside the channel noise."""
INITIAL_LOAD_SHARE = 0.1
"""Share of the scatter of a row that the noise of a load reading has at the start of the iteration."""


@dataclass(frozen=True)
class _Differences:
    """Differences B s (t, c) of rows, with `weights` (t,), and the `columns` (c, j) of C0 of the loads with a part.

    `applied` (m, j) tells the rows in which each of these loads was applied.
    """

    B: Array
    values: Array
    weights: Array
    columns: Array
    applied: Array

    @cached_property
    def row_power(self) -> Array:
        """The noise of the channels (t,) in each difference, over that of a row."""
        return np.asarray((self.B**2).sum(axis=1))

    @cached_property
    def load_power(self) -> Array:
        """The noise of the readings (t, j) of each load in each difference, over that of one reading."""
        return np.asarray(self.B**2 @ self.applied)

    def covariances(self, sigma: Array, variance: Array) -> Array:
        """Covariance (t, c, c): noise of the channels, and that of the loads through their columns."""
        loads = np.matmul(self.columns * (self.load_power * variance)[:, None, :], self.columns.T)
        covariance: Array = self.row_power[:, None, None] * sigma + loads
        own = np.arange(len(sigma))
        covariance[:, own, own] *= 1.0 + OWN_VARIANCE_SHARE
        return np.asarray(covariance, float)

    def weighted_columns(self, sigma: Array, variance: Array) -> Array:
        """The inverse covariances times the columns (t, c, j)."""
        shape = (len(self.values), *self.columns.shape)
        return np.asarray(np.linalg.solve(self.covariances(sigma, variance), np.broadcast_to(self.columns, shape)))


def row_noise(
    channels: Array, loads: Array, B: Array, weights: Array, start: Array, dof: float
) -> tuple[NoisePart, ...]:
    """Parts of the covariance of each of the m rows of `channels - C0 loads`.

    channels (m, c), loads (m, 6); B (t, m) maps rows to differences without linear functions of the loads, with
    weights (t,); `start` (c, c): covariance if all rows were equally noisy, known with `dof` degrees of freedom.
    """
    applied = (loads != 0.0).astype(float)
    is_diagonal = dof <= MIN_DOF_PER_SIGNAL * channels.shape[1]
    is_own = np.ptp(loads, axis=0) > 0.0 if is_diagonal else applied.mean(axis=0) < ALWAYS_APPLIED_SHARE
    with_part = np.flatnonzero((applied.mean(axis=0) > 0.0) & is_own)
    columns = _linear_sensitivities(channels, loads)[:, with_part]
    differences = _Differences(B, B @ channels, weights, columns, applied[:, with_part])
    variance = INITIAL_LOAD_SHARE / np.maximum(np.sum(columns * np.linalg.solve(start, columns), axis=0), 1e-300)
    pattern = np.eye(len(start)) if is_diagonal else np.ones_like(start)
    sigma = start * pattern
    for _ in range(EM_ITERATIONS):
        scatter, variance = _em_step(differences, sigma, variance)
        sigma = scatter * pattern
    channel_part = NoisePart(sigma, np.ones(len(channels)), 1.0, float(np.sqrt(2.0 / dof)))
    errors = _variance_errors(differences, sigma, variance)
    return (
        channel_part,
        *(
            NoisePart(np.outer(column, column), applied[:, j], float(size), float(error))
            for j, column, size, error in zip(with_part, columns.T, variance, errors, strict=True)
        ),
    )


def _linear_sensitivities(channels: Array, loads: Array) -> Array:
    """C0 (c, 6) by least squares; zero where a load was not varied."""
    size = np.ptp(loads, axis=0)
    scaled = (loads - loads.mean(axis=0)) / np.where(size > 0, size, 1.0)
    slopes = np.linalg.lstsq(scaled, channels - channels.mean(axis=0), rcond=1e-9)[0]
    return np.asarray((slopes / np.where(size > 0, size, 1.0)[:, None]).T)


def _em_step(differences: _Differences, sigma: Array, variance: Array) -> tuple[Array, Array]:
    """One step: expected noise of the loads in each difference, and the variance components that follow from it."""
    d, columns, weights, H = differences.values, differences.columns, differences.weights, differences.load_power
    load_variance = H * variance
    gain = load_variance[:, :, None] * differences.weighted_columns(sigma, variance).swapaxes(1, 2)
    mean = np.matmul(gain, d[:, :, None])[:, :, 0]
    spread = (
        np.einsum("tj,jk->tjk", load_variance, np.eye(len(variance)))
        - np.matmul(gain, columns) * load_variance[:, None, :]
    )
    second = mean**2 + np.diagonal(spread, axis1=1, axis2=2)
    # Differences without a load contain no noise of its reading.
    share = np.where(H > 0.0, weights[:, None] * H, 0.0)
    variance_in_differences = np.where(H > 0.0, second / np.where(H > 0.0, H, 1.0), 0.0)
    variance = np.sum(share * variance_in_differences, axis=0) / np.maximum(share.sum(axis=0), 1e-300)
    left = d - mean @ columns.T
    scatter = (left.T * weights) @ left + columns @ np.tensordot(weights, spread, 1) @ columns.T
    return scatter / float(weights @ differences.row_power), variance


def _variance_errors(differences: _Differences, sigma: Array, variance: Array) -> Array:
    """Standard errors (j,) of the loads' variances, by their information.

    A difference counts by its share of the noise of the load, as in the estimate, and differences that share rows count
    as the `_independent_count` of them. The variance of a load that is in no difference has an error of
    UNKNOWN_VARIANCE_FACTOR times its estimate and one that would be visible beside the noise of the channels.
    """
    columns, weights, H = differences.columns, differences.weights, differences.load_power
    squared_gain = np.einsum("cj,tcj->tj", columns, differences.weighted_columns(sigma, variance))
    weight = weights[:, None] * H
    root_information = np.sum(weight * H * squared_gain, axis=0) / np.maximum(weight.sum(axis=0), 1e-300)
    counts = np.array([_independent_count(weights, differences.B * rows) for rows in differences.applied.T])
    information = 0.5 * counts * root_information**2
    own = sigma + np.diag(OWN_VARIANCE_SHARE * np.diagonal(sigma))
    visible = np.sum(columns * np.linalg.solve(own, columns), axis=0)
    bound = UNKNOWN_VARIANCE_FACTOR * (variance + 1.0 / np.maximum(visible, 1e-300))
    least = np.where(visible > 0.0, bound**-2.0, np.inf)
    return np.asarray(1.0 / np.sqrt(np.maximum(information, least)))


def _independent_count(weights: Array, B: Array) -> float:
    """Number of independent squares that the weighted squared differences B (t, m) are worth; zero where none is."""
    root = np.sqrt(weights)[:, None] * B
    products = float(np.sum((root @ root.T) ** 2))
    return float(np.sum(root**2)) ** 2 / products if products > 0.0 else 0.0
