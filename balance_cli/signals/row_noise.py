"""Noise of each row of a static run: that of a load's reading is there only where the load was applied.

Differences d (t, c) along the loading are freed of what is linear in the loads, and with it of the loads themselves;
what is left of the reading of load j is its noise n_j seen through the column c_j of C0. With B (t, m) the operator and
h_ij the sum of B_ir^2 over rows r in which j was applied,

    cov d_i = (sum_r B_ir^2) Sigma + sum_j h_ij sigma_j^2 c_j c_j' .

Sigma and the six sigma_j are found together as variance components by expectation-maximisation (Searle, Casella and
McCulloch, Variance Components, 1992, chapter 8). A load that was applied in all rows has its noise in Sigma.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.run_spectrum import NoisePart

Array = NDArray[np.float64]

EM_ITERATIONS = 60
# Share of the rows beyond which a load counts as always applied.
ALWAYS_APPLIED_SHARE = 0.9
UNKNOWN_VARIANCE_FACTOR = 1e3


def row_noise(
    channels: Array, loads: Array, B: Array, weights: Array, start: Array, dof: float
) -> tuple[NoisePart, ...]:
    """Parts of the covariance of each of the m rows of `channels - C0 loads`.

    channels (m, c), loads (m, 6); B (t, m) takes rows to differences that hold nothing linear in the loads, each to
    count by its weight (t,); `start` (c, c): the covariance if all rows were alike, known with `dof`.
    """
    applied = (loads != 0.0).astype(float)
    sometimes = np.flatnonzero((applied.mean(axis=0) > 0.0) & (applied.mean(axis=0) < ALWAYS_APPLIED_SHARE))
    columns = _linear_sensitivities(channels, loads)[:, sometimes]
    power = B**2
    H, whole = power @ applied[:, sometimes], power.sum(axis=1)
    d = B @ channels
    # A tenth of what a row scatters by may be the load's reading, to begin with.
    variance = 0.1 / np.maximum(np.sum(columns * np.linalg.solve(start, columns), axis=0), 1e-300)
    sigma = start
    for _ in range(EM_ITERATIONS):
        sigma, variance = _em_step(sigma, variance, d, columns, H, whole, weights)
    of_channels = NoisePart(sigma, np.ones(len(channels)), 1.0, float(np.sqrt(2.0 / dof)))
    errors = _variance_errors(sigma, variance, columns, H, whole, weights, B, applied[:, sometimes])
    return (
        of_channels,
        *(
            NoisePart(np.outer(column, column), applied[:, j], float(size), float(error))
            for j, column, size, error in zip(sometimes, columns.T, variance, errors, strict=True)
        ),
    )


def _linear_sensitivities(channels: Array, loads: Array) -> Array:
    """C0 (c, 6) by least squares; zero where a load was not varied."""
    size = np.ptp(loads, axis=0)
    scaled = (loads - loads.mean(axis=0)) / np.where(size > 0, size, 1.0)
    slopes = np.linalg.lstsq(scaled, channels - channels.mean(axis=0), rcond=1e-9)[0]
    return np.asarray((slopes / np.where(size > 0, size, 1.0)[:, None]).T)


def _em_step(
    sigma: Array, variance: Array, d: Array, columns: Array, H: Array, whole: Array, weights: Array
) -> tuple[Array, Array]:
    """One step: what each difference says of the loads' noise in it, and the components that fit to that."""
    own = H * variance
    covariance = whole[:, None, None] * sigma + np.einsum("tj,cj,dj->tcd", own, columns, columns)
    gain = own[:, :, None] * np.linalg.solve(covariance, np.broadcast_to(columns, (len(d), *columns.shape))).swapaxes(
        1, 2
    )
    mean = np.matmul(gain, d[:, :, None])[:, :, 0]
    spread = np.einsum("tj,jk->tjk", own, np.eye(len(variance))) - np.matmul(gain, columns) * own[:, None, :]
    second = mean**2 + np.diagonal(spread, axis1=1, axis2=2)
    # Differences of another load say nothing of this one's reading.
    share = np.where(H > 0.0, weights[:, None] * H, 0.0)
    each = np.where(H > 0.0, second / np.where(H > 0.0, H, 1.0), 0.0)
    variance = np.sum(share * each, axis=0) / np.maximum(share.sum(axis=0), 1e-300)
    left = d - mean @ columns.T
    scatter = (left.T * weights) @ left + np.einsum("t,cj,tjk,dk->cd", weights, columns, spread, columns)
    return scatter / float(weights @ whole), variance


def _variance_errors(
    sigma: Array, variance: Array, columns: Array, H: Array, whole: Array, weights: Array, B: Array, applied: Array
) -> Array:
    """Standard errors (j,) of the loads' variances, by their information.

    Neighbouring differences share rows: so many of them are worth what `_effective_dof` says. Of a load that no
    difference tells of, the variance is any up to `UNKNOWN_VARIANCE_FACTOR` times what would show beside the channels'
    noise.
    """
    covariance = whole[:, None, None] * sigma + np.einsum("tj,cj,dj->tcd", H * variance, columns, columns)
    seen = np.einsum(
        "cj,tcj->tj", columns, np.linalg.solve(covariance, np.broadcast_to(columns, (len(H), *columns.shape)))
    )
    information = 0.5 * np.sum(weights[:, None] * (H * seen) ** 2, axis=0)
    effective_information = information * np.array([_effective_dof(weights, B * rows) for rows in applied.T])
    visible = np.sum(columns * np.linalg.solve(sigma, columns), axis=0)
    return np.asarray(
        1.0
        / np.sqrt(
            np.maximum(effective_information, np.where(visible > 0.0, (visible / UNKNOWN_VARIANCE_FACTOR) ** 2, np.inf))
        )
    )


def _effective_dof(weights: Array, B: Array) -> float:
    """Degrees of freedom of the weighted squares of differences B (t, m), for each; zero where there are none."""
    own = weights * np.sum(B**2, axis=1)
    root = np.sqrt(weights)[:, None] * B
    together = float(np.sum((root @ root.T) ** 2))
    return float(np.sum(own**2)) / together if together > 0.0 else 0.0
