"""Noise covariances of channels and loads from the residuals of local models.

A residual is e = v_Y - G v_U: the noise of the channels, and that of the load signals times the response. Near a
lightly damped mode the second is much larger and follows the mode; away from it the first dominates. The two
covariances are therefore estimated together, as variance components (Searle, Casella and McCulloch, Variance
Components, 1992, chapter 8): that of the channels pooled over neighboring lines, that of the loads over all lines.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.covariance_pooling import invert_pooled, pooled_covariance

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

EM_ITERATIONS = 10
"""Most steps of the estimate; expectation-maximization ends earlier where it has converged."""
WHOLE_SPECTRUM = slice(None)

LEAST_CHANNEL_NOISE = 1e-3
"""Added to the variances of the channels, which are about 1 in the units used; a computed record has no noise."""

LEAST_LOAD_NOISE = 1e-4
"""Least variance of a load, where that of another load is found, over the variance of its estimate from one line."""
LOAD_CONVERGENCE, CHANNEL_CONVERGENCE = 0.02, 0.01
"""Relative changes of the variances below which the estimate has converged; their statistical errors are larger."""


@dataclass(frozen=True)
class WeightedResponse:
    """C^-1 G (K, c, u) for the noise C of the channels, and `information` (K, u, u), G* C^-1 G."""

    response: ComplexArray
    information: ComplexArray


@dataclass(frozen=True)
class NoiseCovariances:
    """Noise covariance of `channels` (K, c, c) at K lines, with its complex degrees of freedom; of `loads` (u, u)."""

    channels: ComplexArray
    loads: ComplexArray
    dof: float

    def equation_error_covariance(self, response: ComplexArray, lines: slice = WHOLE_SPECTRUM) -> ComplexArray:
        """Return the covariance (k, c, c) of `Y - G U` at some of the lines, for a response G (K, c, u)."""
        G = response[lines]
        return np.asarray(self.channels[lines] + G @ self.loads @ G.conj().swapaxes(1, 2))

    def relative_variance(self, response: ComplexArray) -> Array:
        """Return the mean variance (K,) of `Y - G U` over that of the channels: 1 where the loads add no noise."""
        return self.relative_variance_of(self.weigh(response))

    def relative_variance_of(self, weighted: WeightedResponse) -> Array:
        """Return the same for a response that is weighted already."""
        added = np.trace(self.loads @ weighted.information, axis1=1, axis2=2).real
        return np.asarray(1.0 + added / self.channels.shape[1])

    def weigh(self, response: ComplexArray) -> WeightedResponse:
        """Return a response (K, c, u) weighted by the inverse covariance of the channels."""
        weighted = invert_pooled(self.channels) @ response
        return WeightedResponse(weighted, response.conj().swapaxes(1, 2) @ weighted)


def estimate_noise_covariances(
    residual: ComplexArray, response: ComplexArray, counts: Array, least_dof: float
) -> NoiseCovariances:
    """Estimate the noise covariances of channels and loads from residuals (K, c) at lines with response (K, c, u).

    `counts` (K,) is the share of a degree of freedom that the fit left to each line; the expectation of the squared
    residual is that share of the noise. The covariance of the channels is pooled over as many lines as give
    `least_dof` degrees of freedom.
    """
    scaled = residual / np.sqrt(counts)[:, None]
    noise = _initial_covariances(scaled, response, counts, least_dof)
    for _ in range(EM_ITERATIONS):
        previous, weighted = noise, noise.weigh(response)
        noise = replace(noise, loads=_update_load_noise(scaled, weighted, noise))
        noise = _update_channel_noise(scaled, response, weighted, noise, counts, least_dof)
        if _has_converged(noise, previous):
            break
    return noise


def _initial_covariances(
    residual: ComplexArray, response: ComplexArray, counts: Array, least_dof: float
) -> NoiseCovariances:
    """Noise of the channels from lines of small response, where that of the loads is negligible; the latter is zero."""
    u = response.shape[2]
    power = np.sum(np.abs(response) ** 2, axis=(1, 2))
    weight = counts / (1.0 + power / max(float(np.median(power)), 1e-300)) ** 2
    channels, dof = pooled_covariance(
        _outer_products(residual) * weight[:, None, None], weight, least_dof, LEAST_CHANNEL_NOISE
    )
    return NoiseCovariances(channels, np.zeros((u, u), complex), dof)


def _update_channel_noise(
    residual: ComplexArray,
    response: ComplexArray,
    weighted: WeightedResponse,
    noise: NoiseCovariances,
    counts: Array,
    least_dof: float,
) -> NoiseCovariances:
    """Update the covariance of the channels by a step of expectation-maximization.

    The weight of a line is the inverse square of its noise over that of the channels alone. The covariance of the loads
    then has little influence, and the iteration converges within a few steps.
    """
    if not np.any(noise.loads):
        return noise
    weight = counts / noise.relative_variance_of(weighted) ** 2
    explained, posterior = _conditional_load_noise(residual, weighted, noise)
    channel_residual = residual + np.matmul(response, explained[:, :, None])[:, :, 0]
    scatter = _outer_products(channel_residual) + response @ posterior @ response.conj().swapaxes(1, 2)
    channels, dof = pooled_covariance(scatter * weight[:, None, None], weight, least_dof, LEAST_CHANNEL_NOISE)
    return replace(noise, channels=channels, dof=dof)


def _has_converged(current: NoiseCovariances, previous: NoiseCovariances) -> bool:
    """Whether two steps differ little in the covariance of the loads and in the mean variances of the channels."""
    now, before = (np.diagonal(noise.channels, axis1=1, axis2=2).real.mean(axis=0) for noise in (current, previous))
    loads_converged = np.allclose(current.loads, previous.loads, rtol=LOAD_CONVERGENCE, atol=0.0)
    return loads_converged and np.allclose(now, before, rtol=CHANNEL_CONVERGENCE)


def _outer_products(vectors: ComplexArray) -> ComplexArray:
    """Outer product (K, c, c) of each vector (K, c) with itself."""
    return np.asarray(vectors[:, :, None] * vectors[:, None, :].conj())


def _conditional_load_noise(
    residual: ComplexArray, weighted: WeightedResponse, noise: NoiseCovariances
) -> tuple[ComplexArray, ComplexArray]:
    """Mean (K, u) and covariance (K, u, u) of the noise L of the loads, given the residuals.

    The gain is L G* (C + G L G*)^-1 = (1 + L G* C^-1 G)^-1 L G* C^-1 (Woodbury).
    """
    loads, information = noise.loads, weighted.information
    gain = np.linalg.solve(np.eye(len(loads)) + loads @ information, loads @ weighted.response.conj().swapaxes(1, 2))
    mean = -np.matmul(gain, residual[:, :, None])[:, :, 0]
    posterior = np.linalg.solve(np.eye(len(loads)) + loads @ information, np.broadcast_to(loads, information.shape))
    return mean, np.asarray(posterior)


def _update_load_noise(residual: ComplexArray, weighted: WeightedResponse, noise: NoiseCovariances) -> ComplexArray:
    """Update the load covariance by a scoring step from the best linear estimate of their noise at each line."""
    information = weighted.information
    ridge = np.trace(information, axis1=1, axis2=2).real[:, None, None] * 1e-9 + 1e-300
    error_covariance = np.linalg.inv(information + ridge * np.eye(len(noise.loads)))
    estimate = -np.matmul(error_covariance @ weighted.response.conj().swapaxes(1, 2), residual[:, :, None])[:, :, 0]
    # Every exciter has its own force cell, so that the noises of the loads are independent of each other.
    error_variance = np.diagonal(error_covariance, axis1=1, axis2=2).real
    weight = (error_variance + np.diag(noise.loads).real) ** -2.0
    variance = np.sum(weight * (np.abs(estimate) ** 2 - error_variance), axis=0) / weight.sum(axis=0)
    if not np.any(variance > 0.0):
        return np.zeros_like(noise.loads)
    least = LEAST_LOAD_NOISE * np.sum(weight * error_variance, axis=0) / weight.sum(axis=0)
    return np.diag(np.maximum(variance, least)).astype(complex)
