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

from balance_cli.signals.covariance_pooling import PooledCovariance, invert_pooled, pooled_covariance

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

EM_ITERATIONS = 10
"""Most steps of the estimate; expectation-maximization ends earlier where it has converged."""
WHOLE_SPECTRUM = slice(None)

LEAST_CHANNEL_NOISE = 1e-3
"""Added to the variances of the channels, which are about 1 in the units used; a computed record has no noise."""

NOISELESS_RIDGE = 1e-9
"""Of the mean noise of the channels: far above rounding, far below the differences of noise between channels."""
LEAST_RESPONSE_SHARE = 1e-3
"""Least power of a response beside its noise: lines where it is all noise have a millionth of the weight of others."""
LEAST_LOAD_NOISE = 1e-4
"""Least variance of a load, where that of another load is found, over the variance of its estimate from one line."""
LOAD_CONVERGENCE, CHANNEL_CONVERGENCE = 0.02, 0.01
"""Relative changes of the variances below which the estimate has converged; their statistical errors are larger."""


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
        information = response.conj().swapaxes(1, 2) @ (invert_pooled(self.channels) @ response)
        return _relative_variance(information, np.diag(self.loads).real, self.channels.shape[1])


@dataclass(frozen=True)
class _Estimate:
    """The estimate while it is improved: covariance of the channels, variances (u,) of the loads."""

    channels: PooledCovariance
    loads: Array


@dataclass(frozen=True)
class _WeightedResponse:
    """The part G (K, c, u) of a response that is no noise, C^-1 G for the noise C of the channels, and `information`.

    `information` (K, u, u) is G* C^-1 G.
    """

    response: ComplexArray
    weighted: ComplexArray
    information: ComplexArray


def _relative_variance(information: ComplexArray, loads: Array, channels: int) -> Array:
    return np.asarray(1.0 + np.diagonal(information, axis1=1, axis2=2).real @ loads / channels)


def estimate_noise_covariances(
    residual: ComplexArray, response: ComplexArray, counts: Array, least_dof: float, variance: Array | float = 0.0
) -> NoiseCovariances:
    """Estimate the noise covariances of channels and loads from residuals (K, c) at lines with response (K, c, u).

    `counts` (K,) is the share of a degree of freedom that the fit left to each line; the expectation of the squared
    residual is that share of the noise. The covariance of the channels is pooled over as many lines as give
    `least_dof` degrees of freedom. `variance` (K,): that of the response, summed over the loads, over the variance of
    the channels.
    """
    scaled = residual / np.sqrt(counts)[:, None]
    noise = _initial_estimate(scaled, response, counts, least_dof)
    for _ in range(EM_ITERATIONS):
        previous, weighted = noise, _weigh(response, noise.channels, variance)
        noise = replace(noise, loads=_update_load_noise(scaled, weighted, noise.loads))
        noise = _update_channel_noise(scaled, weighted, noise, counts, least_dof)
        if _has_converged(noise, previous):
            break
    return NoiseCovariances(noise.channels.at_lines, np.diag(noise.loads).astype(complex), noise.channels.dof)


def _weigh(response: ComplexArray, channels: PooledCovariance, variance: Array | float) -> _WeightedResponse:
    """Return a response (K, c, u) weighted by the inverse covariance of the channels, less what is noise in it.

    Where a load is weak its response is noise, G* C^-1 G of which is large: it would pass for a response that
    transmits no noise of the load, since none is in the residual.
    """
    weighted = channels.solve(response.swapaxes(1, 2)).swapaxes(1, 2)
    information = response.conj().swapaxes(1, 2) @ weighted
    size = np.maximum(np.trace(information, axis1=1, axis2=2).real, 1e-300)
    share = np.maximum(1.0 - response.shape[1] * variance / size, LEAST_RESPONSE_SHARE)[:, None, None]
    return _WeightedResponse(response * np.sqrt(share), weighted * np.sqrt(share), information * share)


def _initial_estimate(residual: ComplexArray, response: ComplexArray, counts: Array, least_dof: float) -> _Estimate:
    """Noise of the channels from lines of small response, where that of the loads is negligible; the latter is zero."""
    power = np.sum(np.abs(response) ** 2, axis=(1, 2))
    weight = counts / (1.0 + power / max(float(np.median(power)), 1e-300)) ** 2
    deviations = (residual * np.sqrt(weight)[:, None])[:, None, :]
    return _Estimate(pooled_covariance(deviations, weight, least_dof, LEAST_CHANNEL_NOISE), np.zeros(response.shape[2]))


def _update_channel_noise(
    residual: ComplexArray,
    weighted: _WeightedResponse,
    noise: _Estimate,
    counts: Array,
    least_dof: float,
) -> _Estimate:
    """Update the covariance of the channels by a step of expectation-maximization.

    The weight of a line is the inverse square of its noise over that of the channels alone. The covariance of the loads
    then has little influence, and the iteration converges within a few steps.
    """
    if not np.any(noise.loads):
        return noise
    weight = counts / _relative_variance(weighted.information, noise.loads, residual.shape[1]) ** 2
    explained, root = _conditional_load_noise(residual, weighted, noise.loads)
    G = weighted.response
    deviations = np.concatenate([residual[:, :, None] + G @ explained[:, :, None], G @ root], axis=2)
    deviations = (deviations * np.sqrt(weight)[:, None, None]).swapaxes(1, 2)
    return replace(noise, channels=pooled_covariance(deviations, weight, least_dof, LEAST_CHANNEL_NOISE))


def _has_converged(current: _Estimate, previous: _Estimate) -> bool:
    """Whether two steps differ little in the variances of the loads and in the mean variances of the channels."""
    now, before = (_mean_variances(noise.channels) for noise in (current, previous))
    loads_converged = np.allclose(current.loads, previous.loads, rtol=LOAD_CONVERGENCE, atol=0.0)
    return loads_converged and np.allclose(now, before, rtol=CHANNEL_CONVERGENCE)


def _mean_variances(covariance: PooledCovariance) -> Array:
    """Return the variances (c,) of the channels in the mean over all lines."""
    variance = np.diagonal(covariance.knots, axis1=1, axis2=2).real
    return np.asarray(np.bincount(covariance.nearest) @ variance / covariance.lines)


def _conditional_load_noise(
    residual: ComplexArray, weighted: _WeightedResponse, loads: Array
) -> tuple[ComplexArray, ComplexArray]:
    """Mean (K, u) of the noise of the loads, given the residuals, and a root (K, u, u) of its covariance.

    With S = I + l G* C^-1 G l, where l are the standard deviations of the loads, the gain is l S^-1 l G* C^-1
    (Woodbury), and the covariance l S^-1 l.
    """
    sigma = np.sqrt(loads)
    system = np.eye(len(loads)) + sigma[:, None] * weighted.information * sigma
    root = sigma[:, None] * np.linalg.inv(np.linalg.cholesky(system)).conj().swapaxes(1, 2)
    projected = weighted.weighted.conj().swapaxes(1, 2) @ residual[:, :, None]
    mean = -(root @ (root.conj().swapaxes(1, 2) @ projected))[:, :, 0]
    return np.asarray(mean), np.asarray(root)


def _update_load_noise(residual: ComplexArray, weighted: _WeightedResponse, loads: Array) -> Array:
    """Update the variances (u,) of the loads by a scoring step from the best linear estimate of their noise."""
    information = weighted.information
    ridge = np.trace(information, axis1=1, axis2=2).real[:, None, None] * 1e-9 + 1e-300
    error_covariance = np.linalg.inv(information + ridge * np.eye(len(loads)))
    estimate = -np.matmul(error_covariance @ weighted.weighted.conj().swapaxes(1, 2), residual[:, :, None])[:, :, 0]
    # Every exciter has its own force cell, so that the noises of the loads are independent of each other.
    error_variance = np.diagonal(error_covariance, axis1=1, axis2=2).real
    weight = (error_variance + loads) ** -2.0
    variance = np.sum(weight * (np.abs(estimate) ** 2 - error_variance), axis=0) / weight.sum(axis=0)
    if not np.any(variance > 0.0):
        return np.zeros_like(loads)
    least = LEAST_LOAD_NOISE * np.sum(weight * error_variance, axis=0) / weight.sum(axis=0)
    return np.asarray(np.maximum(variance, least))


def whitening_matrices(covariance: ComplexArray) -> ComplexArray:
    """Return matrices (K, c, c) that make noise of this covariance (K, c, c) white."""
    try:
        root = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        # Computed records have no noise in some directions, but rounding, which may be of either sign.
        c = covariance.shape[1]
        size = np.maximum(np.trace(covariance, axis1=1, axis2=2).real / c, np.finfo(float).tiny)
        root = np.linalg.cholesky(covariance + (NOISELESS_RIDGE * size)[:, None, None] * np.eye(c))
    return np.asarray(np.linalg.inv(root), complex)
