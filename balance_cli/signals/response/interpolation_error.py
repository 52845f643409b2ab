"""Error of the interpolation of a measured response between its lines, beyond the noise of the lines.

Sigma of an interpolated value is that of a curve which has the right form. Whether it has is seen at the lines: the two
lines beside a frequency are left out one after the other and predicted from the others. What a prediction misses beyond
the noise is an error of the form. It is an upper value, because a line that is left out doubles the spacing
(cross-validation; Stone, J. Royal Stat. Soc. B 36, 1974).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.distributions import chi2
from balance_cli.signals.response.interpolation import InterpolatedResponse, interpolate_response
from balance_cli.signals.run_spectrum import FrequencyResponse

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

FEWEST_LINES = 3
"""Lines of a response of which one can be left out and predicted from two others."""
HALF_WIDTH = 0.005
"""Half width of a light mode over its frequency. A line that stands on one tells the response at a distance d to d over
its half width; rigs have damping ratios of 0.3 to 3 %."""
NOISE_PROBABILITY = 0.05
"""Probability with which noise alone counts as an error of the form: sigma of a well resolved response hardly grows."""


@dataclass(frozen=True)
class InterpolationWithError:
    """An interpolated response whose covariance contains the error of the form of the curve, `form` (h, c, c) of it.

    Both belong to its load_covariance.
    """

    response: InterpolatedResponse
    form: ComplexArray


def interpolate_with_error(response: FrequencyResponse, frequency: Array, method: str) -> InterpolatedResponse:
    """Return the response at `frequency` (h,) [Hz] as `interpolate_response`, with the error of the interpolation.

    Raises UserError outside the measured lines.
    """
    return interpolate_and_judge(response, frequency, method).response


def interpolate_and_judge(response: FrequencyResponse, frequency: Array, method: str) -> InterpolationWithError:
    """Return the response at `frequency` (h,) [Hz] with the error of the interpolation, also by itself.

    Raises UserError outside the measured lines.
    """
    value = interpolate_response(response, frequency, method)
    if len(response.frequency) < FEWEST_LINES:
        return InterpolationWithError(value, np.zeros_like(value.channel_covariance))
    above = np.clip(np.searchsorted(response.frequency, frequency), 1, len(response.frequency) - 1)
    both, loads = np.concatenate([above - 1, above]), np.concatenate([value.load_covariance] * 2)
    below, beyond = np.split(_form_error(response, both, loads, method), 2)
    form, near = 0.5 * (below + beyond), _distance_error(response, frequency, value.load_covariance)
    is_near = np.trace(near, axis1=1, axis2=2).real < np.trace(form, axis1=1, axis2=2).real
    form = np.where(is_near[:, None, None], near, form)
    return InterpolationWithError(replace(value, channel_covariance=value.channel_covariance + form), form)


def _distance_error(response: FrequencyResponse, frequency: Array, loads: ComplexArray) -> ComplexArray:
    """Return the covariance (h, c, c) of what the nearest line may differ by from the response at each frequency.

    A curve passes through that line within its noise, which is in it.
    """
    line = np.argmin(np.abs(response.frequency - frequency[:, None]), axis=1)
    distance = np.abs(response.frequency[line] - frequency) / (HALF_WIDTH * np.maximum(frequency, np.finfo(float).tiny))
    precision = np.linalg.inv(loads) / loads.shape[1]
    measured = response.response[line]
    change = np.einsum("hcu,huv,hdv->hcd", measured, precision, measured.conj()) * distance[:, None, None] ** 2
    ratio = np.einsum("huv,hvu->h", response.load_covariance[line], precision).real
    return np.asarray(change + response.channel_covariance[line] * ratio[:, None, None])


def _form_error(response: FrequencyResponse, line: Index, loads: ComplexArray, method: str) -> ComplexArray:
    """Return the covariance (h, c, c) of what the prediction of each `line` (h,) from the others misses.

    It is that of the channels where the loads have the covariance `loads` (h, u, u).
    """
    predicted = interpolate_response(response, response.frequency[line], method, left_out=line)
    missed = predicted.value - response.response[line]
    variance = _variances(predicted.channel_covariance, predicted.load_covariance)
    variance = variance + _variances(response.channel_covariance[line], response.load_covariance[line])
    tested = variance > 0
    power = np.abs(missed) ** 2 / np.where(tested, variance, 1.0)
    count = np.maximum(tested.sum(axis=(1, 2)), 1)
    ratio = power.sum(axis=(1, 2), where=tested) / count
    beyond_noise = np.where(ratio > chi2.isf(NOISE_PROBABILITY, 2 * count) / (2 * count), 1.0 - 1.0 / ratio, 0.0)
    precision = np.linalg.inv(loads) / missed.shape[2]
    square = np.einsum("hcu,huv,hdv->hcd", missed, precision, missed.conj())
    return np.asarray(square * beyond_noise[:, None, None])


def _variances(channels: ComplexArray, loads: ComplexArray) -> Array:
    """Return the variances (h, c, u) of a separable covariance."""
    return np.asarray(
        np.diagonal(channels, axis1=1, axis2=2).real[:, :, None] * np.diagonal(loads, axis1=1, axis2=2).real[:, None, :]
    )
