"""What the runs of a campaign leave uncertain of the hub loads, and what an effect that is not found does to them.

Loads u at harmonic n are reduced from channels y by u = G y, G = (T* C^-1 T)^-1 T* C^-1 with the noise C of the
channels. An error dT of the response makes the error -G dT u. With the derivatives of T a covariance of the parameters
becomes one of the loads; and an effect of size d that the model lacks, which the fitted parameters hide by changing as
far as they can, becomes an error of the loads.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.independence import has_independent_columns
from balance_cli.campaign.rig.load_components import carried_components
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS
from balance_cli.model.response_jacobian import output_jacobian
from balance_cli.model.system_response import response, solve
from balance_cli.planning.channel_noise import ChannelNoise, channel_sigma
from balance_cli.planning.detectability import SmallestSize
from balance_cli.planning.extended_model import ExtendedModel
from balance_cli.signals.anti_alias import anti_alias_response

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class LoadForecast:
    """Derivatives of the reduced loads of a record with the rotor turning.

    `frequency` (h,) [Hz]; `components` (m,) carried; `reference` (m,) amplitude [N, N m] of each, all of which act at
    once with independent phases; `jacobian` (h, m, m, p): change of reduced load i, by the applied load j at its
    reference, per unit of each parameter; `noise` (h, m), standard deviation of cosine and sine by the channels' noise.
    """

    frequency: Array
    components: tuple[str, ...]
    reference: Array
    jacobian: ComplexArray
    noise: Array


def load_forecast(
    model: ExtendedModel, noise: ChannelNoise, reference: Mapping[str, float], sample_rate: float, seconds: float
) -> LoadForecast | None:
    """Prepare the forecast for a record of the given length [s]; None without a rotor or with too few channels."""
    geometry = model.model.geometry
    if geometry.rotor is None:
        return None
    speed = geometry.rotor.speed
    frequency = speed * np.arange(1.0, DEFAULT_SETTINGS.worth.harmonics + 1.0)
    frequency = frequency[frequency < sample_rate / 2.0]
    components = carried_components(geometry)
    columns = np.array([COMPONENTS.index(name) for name in components], np.intp)
    system = model.model.system(model.theta)
    solution = solve(system, frequency, speed)
    T = response(system, solution)[:, :, columns]
    weight = _precision(geometry, noise, frequency, sample_rate, seconds)
    amplitude = np.array([reference[name] for name in components])
    if not has_independent_columns(np.sqrt(weight)[:, :, None] * T, 1.0 / amplitude):
        return None
    G, covariance = _weighted_inverse(T, weight)
    jacobian = np.zeros((len(frequency), len(columns), len(columns), model.size), complex)
    for k, (j, size) in enumerate(zip(columns, amplitude, strict=True)):
        loads = np.zeros((len(frequency), 6), complex)
        loads[:, j] = size
        jacobian[:, :, k] = G @ output_jacobian(system, solution, np.arange(len(frequency)), loads)
    return LoadForecast(frequency, components, amplitude, jacobian, np.sqrt(0.5 * covariance))


def _precision(geometry: Geometry, noise: ChannelNoise, frequency: Array, sample_rate: float, seconds: float) -> Array:
    """One over the variance (h, c) of the amplitude of a line, the anti-alias filter taken out."""
    gain = np.abs(anti_alias_response(geometry.acquisition, frequency))[:, None]
    variance = 4.0 * channel_sigma(noise, geometry.channels) ** 2 / (sample_rate * seconds)
    return np.asarray(gain**2 / variance)


def _weighted_inverse(T: ComplexArray, weight: Array) -> tuple[ComplexArray, Array]:
    """G (h, m, c) and the variance (h, m) of the loads by noise; G = (T* W T)^-1 T* W."""
    root = np.sqrt(weight)[:, :, None]
    size = np.linalg.norm(root * T, axis=1)[:, :, None]
    inverse = np.linalg.pinv(root * T / size.swapaxes(1, 2)) / size
    return np.asarray(inverse * root.swapaxes(1, 2), complex), np.sum(np.abs(inverse) ** 2, axis=2)


def parameter_sigma(forecast: LoadForecast, model: ExtendedModel, covariance: Array) -> Array:
    """Standard deviation (h, m) of cosine and sine of each load by the covariance (f, f) of the fitted parameters."""
    J = forecast.jacobian[:, :, :, model.indices.fitted]
    variance = np.real(np.einsum("himp,pq,himq->hi", J, covariance, J.conj(), optimize=True))
    return np.asarray(np.sqrt(np.maximum(0.5 * variance, 0.0)))


def total_sigma(forecast: LoadForecast, model: ExtendedModel, covariance: Array) -> Array:
    """Standard deviation (h, m) of cosine and sine of each load, by parameters and by the noise of the record."""
    return np.asarray(np.hypot(parameter_sigma(forecast, model, covariance), forecast.noise))


def load_error(forecast: LoadForecast, model: ExtendedModel, projection: Array, size: SmallestSize) -> Array | None:
    """Largest error (m,) of each load's amplitude over the harmonics, where an effect of this size is not modeled.

    `projection` (f, t): of `ProjectedInformation`. None where the size is not finite, or where the effect is no part of
    the linear response.
    """
    tested = np.concatenate(model.indices.tested)
    parameter = int(tested[size.index])
    if not np.isfinite(size.size) or not np.any(forecast.jacobian[..., parameter]):
        return None
    change = forecast.jacobian[..., parameter] * size.size
    hidden = forecast.jacobian[..., model.indices.fitted] @ projection[:, size.index]
    # The loads act with independent phases: their errors add up as squares.
    error = np.sqrt(np.sum(np.abs(change - size.size * hidden) ** 2, axis=2))
    return np.asarray(error.max(axis=0))
