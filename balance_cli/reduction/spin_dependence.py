"""What measured responses at one rotor speed miss of those at another: gyroscopic moments, bearings, blades.

What spins acts on the balance as a load does, so that the redundant channels do not show it: loads by responses at
rest were up to 71 standard deviations off without a flag. Sweeps of one load at two rotor speeds tell it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.estimation.choices import GOOD_FIT_CHI2_PER_DOF
from balance_cli.estimation.response_error import ResponseError
from balance_cli.estimation.response_error_estimate import Residuals, response_error_of_residuals
from balance_cli.signals.response.interpolation import interpolate_response
from balance_cli.signals.run_spectrum import FrequencyResponse

Array = NDArray[np.float64]

SAME_SPEED = 0.1
"""Relative difference of two rotor speeds whose responses count as one: gyroscopic moments grow with the speed."""


@dataclass(frozen=True)
class SpinDependence:
    """Error of responses to the six loads for a rotor speed that differs by 1 Hz from that of their sweeps."""

    error: ResponseError

    def at(self, distance: Array) -> ResponseError:
        """Return the error for rotor speeds that differ by `distance` (6,) [Hz]."""
        return replace(self.error, factor=self.error.factor * distance[:, None, None])


def nearest_responses(
    candidates: Sequence[FrequencyResponse], usual: Sequence[FrequencyResponse], speed: float
) -> tuple[FrequencyResponse, ...]:
    """Return for each load the response at a rotor speed [Hz], or the `usual` ones where some load has none there.

    Responses at different speeds are responses of different rigs.
    """
    near = {
        response.components[0]: response
        for response in candidates
        if abs(response.rotor_speed - speed) <= SAME_SPEED * speed
    }
    if all(response.components[0] in near for response in usual):
        return tuple(near[response.components[0]] for response in usual)
    return tuple(usual)


def spin_dependence(candidates: Sequence[FrequencyResponse], interpolation: str) -> SpinDependence | None:
    """Return what the rotor speed changes of the responses, each to one load; None where that is no more than noise.

    Loads that were applied at one speed only are assumed to have the largest relative change of the others, in the
    same directions.
    """
    parts = []
    for first in candidates:
        for second in candidates:
            if first.components == second.components and first.rotor_speed < second.rotor_speed:
                change = _change(first, second, interpolation)
                if change is not None:
                    parts.append((COMPONENTS.index(first.components[0]), change))
    error = response_error_of_residuals(parts, candidates[0].channel_names) if parts else None
    if error is None:
        return None
    return SpinDependence(_with_unmeasured_loads(error, candidates))


def _change(first: FrequencyResponse, second: FrequencyResponse, interpolation: str) -> Residuals | None:
    """Return the change of a response for a change of the rotor speed by 1 Hz; None where it is that of noise."""
    inside = (first.frequency >= second.frequency[0]) & (first.frequency <= second.frequency[-1])
    if not inside.any():
        return None
    if np.array_equal(first.frequency, second.frequency):
        value, covariance = second.response, second.channel_covariance * second.load_covariance[:, :1, :1]
    else:
        other = interpolate_response(second, first.frequency[inside], interpolation)
        value, covariance = other.value, other.channel_covariance * other.load_covariance[:, :1, :1]
    change = value[:, :, 0] - first.response[inside, :, 0]
    covariance = covariance + first.channel_covariance[inside] * first.load_covariance[inside, :1, :1]
    variance = np.einsum("kcc->kc", covariance).real
    if np.mean(np.abs(change) ** 2 / np.maximum(variance, np.finfo(float).tiny)) <= GOOD_FIT_CHI2_PER_DOF:
        return None
    distance = second.rotor_speed - first.rotor_speed
    return Residuals(first.frequency[inside], change / distance, variance / distance**2)


def _with_unmeasured_loads(error: ResponseError, candidates: Sequence[FrequencyResponse]) -> ResponseError:
    """Return the error with that of the loads that have none."""
    size = np.zeros((len(error.frequency), len(COMPONENTS)))
    for response in candidates:
        nearest = np.argmin(np.abs(error.frequency[:, None] - response.frequency), axis=1)
        size[:, COMPONENTS.index(response.components[0])] = np.linalg.norm(response.response[nearest, :, 0], axis=1)
    own = np.sqrt(np.sum(np.abs(error.factor) ** 2, axis=(2, 3)))
    relative = own / np.where(size > 0.0, size, np.inf)
    worst, bands = relative.argmax(axis=1), np.arange(len(size))
    scale = size / np.where(size[bands, worst] > 0.0, size[bands, worst], np.inf)[:, None]
    measured = np.any(own > 0.0, axis=0)
    assumed = error.factor[bands, worst][:, None] * scale[:, :, None, None]
    return replace(error, factor=np.where(measured[:, None, None], error.factor, assumed))
