"""Noise of channels and loads, told apart in the residuals of local models.

A residual is e = v_Y - G v_U: the noise of the channels, and that of the load signals seen through the response. Beside
a lightly damped mode the second is much the larger and follows the mode; away from it the first is seen alone. So the
two covariances are found together, as variance components (Searle, Casella and McCulloch, Variance Components, 1992,
chapter 8), the channels' pooled over neighbouring lines, the loads' over all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.covariance_pooling import pooled_covariance

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

EM_ITERATIONS = 10
WHOLE_SPECTRUM = slice(None)

# Added to the channels' variances, which are about 1 in the units used: a computed record has no noise at all.
LEAST_CHANNEL_NOISE = 1e-3

# Of the variance with which one line tells a load's noise: the least that is assumed beside a load whose noise is seen.
LEAST_LOAD_NOISE = 1e-4


@dataclass(frozen=True)
class NoiseCovariances:
    """Noise at K lines: `channels` (K, c, c), `loads` (u, u), and the complex degrees of freedom of the channels'."""

    channels: ComplexArray
    loads: ComplexArray
    dof: float

    def equation_error_covariance(self, response: ComplexArray, lines: slice = WHOLE_SPECTRUM) -> ComplexArray:
        """Covariance (k, c, c) of `Y - G U` at some of the lines, for a response G (K, c, u)."""
        G = response[lines]
        return np.asarray(self.channels[lines] + G @ self.loads @ G.conj().swapaxes(1, 2))

    def relative_variance(self, response: ComplexArray) -> Array:
        """Mean variance (K,) of `Y - G U` in units of the channels' own noise: 1 where the loads add nothing."""
        seen = np.linalg.solve(self.channels, response @ self.loads @ response.conj().swapaxes(1, 2))
        return np.asarray(1.0 + np.trace(seen, axis1=1, axis2=2).real / self.channels.shape[1])


def estimate_noise_covariances(
    residual: ComplexArray, response: ComplexArray, counts: Array, least_dof: float
) -> NoiseCovariances:
    """Variance components of residuals (K, c) at lines with response (K, c, u) and counts (K,), the share of a degree

    of freedom that the fit left to each line (the residual's expectation is that share of the noise). The channels'
    covariance is pooled over lines enough for `least_dof`.
    """
    scaled = residual / np.sqrt(counts)[:, None]
    noise = _initial_covariances(scaled, response, counts, least_dof)
    for _ in range(EM_ITERATIONS):
        before = noise
        noise = replace(noise, loads=_update_load_noise(scaled, response, noise))
        noise = _update_channel_noise(scaled, response, noise, counts, least_dof)
        if _has_converged(noise, before):
            break
    return noise


def _initial_covariances(
    residual: ComplexArray, response: ComplexArray, counts: Array, least_dof: float
) -> NoiseCovariances:
    """Channels' noise from lines of small response, where the loads' noise is not seen; that of the loads zero."""
    u = response.shape[2]
    size = np.sum(np.abs(response) ** 2, axis=(1, 2))
    weight = counts / (1.0 + size / max(float(np.median(size)), 1e-300)) ** 2
    channels, dof = pooled_covariance(
        _outer_products(residual) * weight[:, None, None], weight, least_dof, LEAST_CHANNEL_NOISE
    )
    return NoiseCovariances(channels, np.zeros((u, u), complex), dof)


def _update_channel_noise(
    residual: ComplexArray, response: ComplexArray, noise: NoiseCovariances, counts: Array, least_dof: float
) -> NoiseCovariances:
    """A better covariance of the channels: what the loads' noise explains is taken out (expectation-maximisation).

    A line counts by the inverse square of its noise in units of the channels' own, so that what is assumed of the
    loads matters little and the iteration converges within a few steps.
    """
    if not np.any(noise.loads):
        return noise
    weight = counts / noise.relative_variance(response) ** 2
    explained, posterior = _conditional_load_noise(residual, response, noise)
    left = residual + np.matmul(response, explained[:, :, None])[:, :, 0]
    scatter = _outer_products(left) + response @ posterior @ response.conj().swapaxes(1, 2)
    channels, dof = pooled_covariance(scatter * weight[:, None, None], weight, least_dof, LEAST_CHANNEL_NOISE)
    return replace(noise, channels=channels, dof=dof)


def _has_converged(current: NoiseCovariances, previous: NoiseCovariances) -> bool:
    """Whether two steps differ by less than two per cent (the loads), or one (the channels, on average)."""
    mine, others = (np.diagonal(noise.channels, axis1=1, axis2=2).real.mean(axis=0) for noise in (current, previous))
    return np.allclose(current.loads, previous.loads, rtol=0.02, atol=0.0) and np.allclose(mine, others, rtol=0.01)


def _outer_products(vectors: ComplexArray) -> ComplexArray:
    """Outer product (K, c, c) of each vector (K, c) with itself."""
    return np.asarray(vectors[:, :, None] * vectors[:, None, :].conj())


def _conditional_load_noise(
    residual: ComplexArray, response: ComplexArray, noise: NoiseCovariances
) -> tuple[ComplexArray, ComplexArray]:
    """Mean (K, u) and covariance (K, u, u) of the loads' noise, given the residuals."""
    gain = noise.loads @ np.linalg.solve(noise.equation_error_covariance(response), response).conj().swapaxes(1, 2)
    mean = -np.matmul(gain, residual[:, :, None])[:, :, 0]
    return mean, np.asarray(noise.loads - gain @ response @ noise.loads)


def _update_load_noise(residual: ComplexArray, response: ComplexArray, noise: NoiseCovariances) -> ComplexArray:
    """One scoring step for the loads' covariance from the best linear estimate of the loads' noise at each line."""
    weighted = np.linalg.solve(noise.channels, response)
    information = response.conj().swapaxes(1, 2) @ weighted
    size = np.trace(information, axis1=1, axis2=2).real[:, None, None] * 1e-9 + 1e-300
    own = np.linalg.inv(information + size * np.eye(len(noise.loads)))
    estimate = -np.matmul(own @ weighted.conj().swapaxes(1, 2), residual[:, :, None])[:, :, 0]
    # Every exciter has a force cell of its own: their noises are independent of one another.
    own_variance = np.diagonal(own, axis1=1, axis2=2).real
    weight = (own_variance + np.diag(noise.loads).real) ** -2.0
    found = np.sum(weight * (np.abs(estimate) ** 2 - own_variance), axis=0) / weight.sum(axis=0)
    if not np.any(found > 0.0):
        return np.zeros_like(noise.loads)
    least = LEAST_LOAD_NOISE * np.sum(weight * own_variance, axis=0) / weight.sum(axis=0)
    return np.diag(np.maximum(found, least)).astype(complex)
