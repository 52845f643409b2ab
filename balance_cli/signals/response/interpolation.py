"""Interpolation of a measured response between its lines.

`local` fits a rational function with poles common to all channels to the neighboring lines, weighted with their
covariance; `spline` is the cubic spline through the lines; `first-order` is T + dT/df (f - f0) from the nearest line,
as in the paper (section 4), with the derivative from its two neighbors; `nearest` is the nearest line.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.io.errors import UserError
from balance_cli.signals.local.fit import LocalFit, ModelOrders, WindowedData, fit_windows
from balance_cli.signals.local.window import (
    WindowFit,
    derivative_rows,
    design_pseudoinverse,
    pole_uncertainty,
    response_rows,
    split_windows,
)
from balance_cli.signals.run_spectrum import FrequencyResponse

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

INTERPOLATION_METHODS = ("local", "spline", "first-order", "nearest")
LOCAL_LINES = 11
"""Lines to which a local model is fitted: enough for a mode and its surroundings, and few enough for low orders."""
SPLINE_LINES = 12
"""Lines of a spline: the weight of a line falls by 2 - sqrt(3) from one to the next, to 4e-4 after six."""
INTERPOLATION_ORDERS = tuple(ModelOrders(degree, -1, poles) for degree in (1, 2, 3) for poles in (0, 1, 2, 3))
LEAST_RELATIVE_SIGMA = 1e-9
"""Least standard deviation over amplitude; a computed response has none."""


@dataclass(frozen=True)
class InterpolatedResponse:
    """Response at h frequencies: value (h, c, u), derivative (h, c, u) per Hz, and covariance of the value.

    The covariance is separable as in `FrequencyResponse`: channel_covariance (h, c, c), load_covariance (h, u, u). For
    a single frequency the arrays have no axis h.
    """

    value: ComplexArray
    derivative: ComplexArray
    channel_covariance: ComplexArray
    load_covariance: ComplexArray


@dataclass(frozen=True)
class _LineWeights:
    """The response as a weighted sum of lines.

    `index` (M,) are the lines, `value` and `derivative` (M,) their weights, `spread` (c, u, s) the standard deviations
    that the uncertainty of the poles adds.
    """

    index: Index
    value: ComplexArray
    derivative: ComplexArray
    spread: ComplexArray


def interpolate_response(
    response: FrequencyResponse,
    frequency: float | Array,
    method: str = "local",
    left_out: Index | None = None,
) -> InterpolatedResponse:
    """Interpolate the response at `frequency` [Hz], a number or (h,), by one of INTERPOLATION_METHODS.

    `left_out` (h,) is the index of a line that is not used at each frequency. Raises UserError outside the measured
    lines.
    """
    query_frequency = np.atleast_1d(np.asarray(frequency, float))
    _check_frequency_range(response, query_frequency)
    weights = _WEIGHT_FUNCTIONS[method](response, query_frequency, left_out)
    results = [_apply_weights(response, line_weights) for line_weights in weights]
    arrays = [np.stack(parts) for parts in zip(*results, strict=True)]
    return InterpolatedResponse(*arrays) if np.ndim(frequency) else InterpolatedResponse(*(part[0] for part in arrays))


def interpolate_values(response: FrequencyResponse, frequency: Array, method: str) -> ComplexArray:
    """Interpolate the value (h, c, u) of the response, without covariance, at many frequencies (h,) [Hz].

    As `interpolate_response`, but one local model is fitted between each two lines and used for all frequencies there.
    """
    query_frequency = np.asarray(frequency, float)
    if method != "local" or len(response.frequency) < 5:
        return interpolate_response(response, query_frequency, method).value
    _check_frequency_range(response, query_frequency)
    index = _neighboring_lines(response, query_frequency, LOCAL_LINES)
    starts, gap = np.unique(index[:, 0], return_inverse=True)
    windows_of = starts[:, None] + np.arange(index.shape[1])
    center = np.array([query_frequency[gap == g].mean() for g in range(len(starts))])
    fits, half, _ = _best_window_fits(response, windows_of, center)
    values = np.empty((len(query_frequency), *response.response.shape[1:]), complex)
    for g, fit in enumerate(fits):
        members = np.flatnonzero(gap == g)
        weights = (response_rows(fit, (query_frequency[members] - center[g]) / half[g]) @ design_pseudoinverse(fit))[
            :, 0
        ]
        values[members] = np.tensordot(weights, response.response[windows_of[g]], axes=1)
    return values


def _check_frequency_range(response: FrequencyResponse, query_frequency: Array) -> None:
    lines = response.frequency
    slack = np.max(np.diff(lines)) if len(lines) > 1 else 0.0
    outside = query_frequency[(query_frequency < lines[0] - slack) | (query_frequency > lines[-1] + slack)]
    if outside.size:
        raise UserError(
            f"the response to {', '.join(response.components)} was measured from {lines[0]:g} to {lines[-1]:g} Hz "
            f"({response.run}), not at {outside[0]:g} Hz",
            remedy="Extend the sweep, or request fewer harmonics",
        )


def _neighboring_lines(
    response: FrequencyResponse, query_frequency: Array, count: int, left_out: Index | None = None
) -> Index:
    """The `count` lines (h, count) around each frequency; at the ends of the band the outermost lines."""
    K = len(response.frequency) - (left_out is not None)
    count = min(count, K)
    above = np.searchsorted(response.frequency, query_frequency)
    if left_out is None:
        return np.asarray(np.clip(above - count // 2, 0, K - count)[:, None] + np.arange(count))
    above = above - (above > left_out)
    index = np.clip(above - count // 2, 0, K - count)[:, None] + np.arange(count)
    return np.asarray(index + (index >= left_out[:, None]))


def _nearest_line(response: FrequencyResponse, query_frequency: Array, left_out: Index | None) -> Index:
    distance = np.abs(response.frequency - query_frequency[:, None])
    if left_out is not None:
        distance[np.arange(len(distance)), left_out] = np.inf
    return np.asarray(np.argmin(distance, axis=1))


def _weights_without_spread(response: FrequencyResponse, index: Index, value: Array, derivative: Array) -> _LineWeights:
    none = np.zeros((*response.response.shape[1:], 0), complex)
    return _LineWeights(index, value.astype(complex), derivative.astype(complex), none)


def _nearest_line_weights(
    response: FrequencyResponse, query_frequency: Array, left_out: Index | None = None
) -> list[_LineWeights]:
    return [
        _weights_without_spread(response, np.array([k]), np.ones(1), np.zeros(1))
        for k in _nearest_line(response, query_frequency, left_out)
    ]


def _first_order_weights(
    response: FrequencyResponse, query_frequency: Array, left_out: Index | None = None
) -> list[_LineWeights]:
    result = []
    nearest = _nearest_line(response, query_frequency, left_out)
    around = _neighboring_lines(response, response.frequency[nearest], 3, left_out)
    for k, index, f in zip(nearest, around, query_frequency, strict=True):
        at_line = np.asarray(index == k, float)
        derivative = _lagrange_derivative(response.frequency[index], response.frequency[k])
        value = at_line + (f - response.frequency[k]) * derivative
        result.append(_weights_without_spread(response, index, value, derivative))
    return result


def _lagrange_derivative(x: Array, at: float) -> Array:
    """Weights (n,) of the derivative at `at` of the polynomial through n points x (Lagrange)."""
    powers = np.vander(x - at, increasing=True)
    return np.asarray(np.linalg.inv(powers)[1] if len(x) > 1 else np.zeros(1))


def _spline_weights(
    response: FrequencyResponse, query_frequency: Array, left_out: Index | None = None
) -> list[_LineWeights]:
    from scipy.interpolate import make_interp_spline

    result = []
    around = _neighboring_lines(response, query_frequency, SPLINE_LINES, left_out)
    for index, f in zip(around, query_frequency, strict=True):
        degree = min(3, len(index) - 1)
        spline = make_interp_spline(response.frequency[index], np.eye(len(index)), k=degree)
        derivative = spline.derivative()(f) if degree else np.zeros(1)
        result.append(_weights_without_spread(response, index, np.asarray(spline(f)), np.asarray(derivative)))
    return result


def _local_model_weights(
    response: FrequencyResponse, query_frequency: Array, left_out: Index | None = None
) -> list[_LineWeights]:
    """Rational functions, with orders selected by Akaike's criterion for known noise, V + 2 p."""
    index = _neighboring_lines(response, query_frequency, LOCAL_LINES, left_out)
    if index.shape[1] < 5:
        return _spline_weights(response, query_frequency, left_out)
    fits, half, sigma = _best_window_fits(response, index, query_frequency)
    return [_window_weights(response, index[h], fits[h], half[h], sigma[h]) for h in range(len(query_frequency))]


def _best_window_fits(response: FrequencyResponse, index: Index, center: Array) -> tuple[list[WindowFit], Array, Array]:
    """The best local model of each window (h, M) of lines about its `center` (h,) [Hz]; half-widths; sigma (h, c u)."""
    offset = response.frequency[index] - center[:, None]
    half = np.max(np.abs(offset), axis=1)
    windows, sigma = _response_windows(response, index, offset / half[:, None])
    candidates = [
        orders for orders in INTERPOLATION_ORDERS if orders.response + orders.denominator + 2 < index.shape[1]
    ]
    fits = [fit_windows(windows, orders) for orders in candidates]
    best = np.argmin([_akaike_criterion(windows, fit) for fit in fits], axis=0)
    window_fits = [split_windows(fit, windows) for fit in fits]
    return [window_fits[best[h]][h] for h in range(len(center))], half, sigma


def _response_windows(response: FrequencyResponse, index: Index, r: Array) -> tuple[WindowedData, Array]:
    """Data of the windows: every channel and component as an output (h, M, c u) of a unit input, scaled by sigma."""
    c, u = response.response.shape[1:]
    values = response.response[index].reshape(*index.shape, c * u)
    channels = np.diagonal(response.channel_covariance, axis1=1, axis2=2).real
    loads = np.diagonal(response.load_covariance, axis1=1, axis2=2).real
    variance = (channels[:, :, None] * loads[:, None, :]).reshape(-1, c * u)[index]
    size = np.max(np.abs(values), axis=1)
    sigma = np.maximum(np.sqrt(np.median(variance, axis=1)), LEAST_RELATIVE_SIGMA * np.where(size > 0, size, 1.0))
    level = np.maximum(np.mean(variance / sigma[:, None, :] ** 2, axis=2), 1e-3)
    ones = np.ones((*index.shape, 1), complex)
    return WindowedData(values / sigma[:, None, :], ones, 1.0 / np.sqrt(level), r), sigma


def _akaike_criterion(windows: WindowedData, fit: LocalFit) -> Array:
    outputs = windows.Y.shape[2]
    return np.asarray(fit.cost + 2.0 * (outputs * fit.orders.coefficients(1) + fit.orders.denominator), float)


def _window_weights(
    response: FrequencyResponse, index: Index, fit: WindowFit, half: float, sigma: Array
) -> _LineWeights:
    """Weights at the middle of the window, and the spread from its poles."""
    c, u = response.response.shape[1:]
    middle = np.zeros(1)
    S = design_pseudoinverse(fit)
    value, derivative = (response_rows(fit, middle) @ S)[0, 0], (derivative_rows(fit, middle) @ S)[0, 0] / half
    if fit.orders.denominator == 0:
        return _LineWeights(index, value, derivative, np.zeros((c, u, 0), complex))
    noise = np.einsum("kce,kuv->kcuev", response.channel_covariance[index], response.load_covariance[index])
    noise = noise.reshape(len(index), c * u, c * u) / (sigma[:, None] * sigma)
    shift = pole_uncertainty(fit, middle, noise)[0, :, 0] * sigma[:, None]
    return _LineWeights(index, value, derivative, shift.reshape(c, u, -1))


def _apply_weights(response: FrequencyResponse, weights: _LineWeights) -> tuple[ComplexArray, ...]:
    """Value, derivative, and the factors of the covariance; that of the loads is from the line of largest weight."""
    lines = response.response[weights.index]
    value = np.tensordot(weights.value, lines, axes=1)
    derivative = np.tensordot(weights.derivative, lines, axes=1)
    main = weights.index[np.argmax(np.abs(weights.value))]
    loads = response.load_covariance[main]
    precision = np.linalg.inv(loads)
    u = len(loads)
    load_ratio = np.einsum("kuv,vu->k", response.load_covariance[weights.index], precision).real / u
    share = _covariance_shares(response, weights.value) * load_ratio
    channels = np.tensordot(share, response.channel_covariance[weights.index], axes=1)
    spread = np.einsum("cua,uv,dva->cd", weights.spread, precision, weights.spread.conj()) / u
    return value, derivative, channels + spread, loads


def _covariance_shares(response: FrequencyResponse, weights: ComplexArray) -> Array:
    """Weights of the covariances of the lines.

    Lines of periodic records are independent. Lines of windows that slide or overlap share their noise, so that an
    average over them has no less.
    """
    size = np.abs(weights)
    return size**2 if response.estimator.startswith("periodic") else size / size.sum()


_WEIGHT_FUNCTIONS: dict[str, Callable[[FrequencyResponse, Array, Index | None], list[_LineWeights]]] = {
    "local": _local_model_weights,
    "spline": _spline_weights,
    "first-order": _first_order_weights,
    "nearest": _nearest_line_weights,
}
