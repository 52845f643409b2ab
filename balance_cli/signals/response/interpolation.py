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
from balance_cli.signals.local.window import derivative_rows, pole_uncertainty, response_rows
from balance_cli.signals.response.line_correction import residual_shares
from balance_cli.signals.response.window_models import LOCAL_LINES, WindowModel, neighboring_lines, window_models
from balance_cli.signals.run_spectrum import FrequencyResponse

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

SPLINE_LINES = 12
"""Lines of a spline: the weight of a line falls by 2 - sqrt(3) from one to the next, to 4e-4 after six."""


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
    that the uncertainty of the poles adds, and that of their number.
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
    """Interpolate the response at `frequency` [Hz], a number or (h,), by one of INTERPOLATIONS.

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

    As `interpolate_response`, in less time.
    """
    query_frequency = np.asarray(frequency, float)
    if method != "local" or len(response.frequency) < 5:
        return interpolate_response(response, query_frequency, method).value
    _check_frequency_range(response, query_frequency)
    index = neighboring_lines(response, query_frequency, LOCAL_LINES)
    starts, gap = np.unique(index[:, 0], return_inverse=True)
    values = np.empty((len(query_frequency), *response.response.shape[1:]), complex)
    for g, model in enumerate(window_models(response, starts[:, None] + np.arange(index.shape[1]))):
        members = np.flatnonzero(gap == g)
        weights, _ = _value_weights(response, model, query_frequency[members])
        values[members] = np.tensordot(weights, response.response[model.index], axes=1)
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
    around = neighboring_lines(response, response.frequency[nearest], 3, left_out)
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
    around = neighboring_lines(response, query_frequency, SPLINE_LINES, left_out)
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
    index = neighboring_lines(response, query_frequency, LOCAL_LINES, left_out)
    if index.shape[1] < 5:
        return _spline_weights(response, query_frequency, left_out)
    models = window_models(response, index)
    return [_window_weights(response, model, f) for model, f in zip(models, query_frequency, strict=True)]


def _value_weights(
    response: FrequencyResponse, model: WindowModel, query_frequency: Array
) -> tuple[ComplexArray, Array]:
    """Weights (n, M) of the lines of a window at frequencies (n,) [Hz], and the shares (n, M) of residuals in them."""
    fit = model.fit
    rows = response_rows(fit, model.position(query_frequency))[:, 0]
    shares = residual_shares(model, response.frequency[model.index], query_frequency)
    return np.asarray((rows - shares @ fit.regressors) @ fit.pseudoinverse + shares), shares


def _window_weights(response: FrequencyResponse, model: WindowModel, query_frequency: float) -> _LineWeights:
    """Weights at a frequency [Hz], and the spread from the poles."""
    c, u = response.response.shape[1:]
    fit, index, sigma = model.fit, model.index, model.sigma
    (value,), (shares,) = _value_weights(response, model, np.atleast_1d(query_frequency))
    used = np.flatnonzero(shares)
    place = np.concatenate([np.atleast_1d(model.position(query_frequency)), fit.r[used]])
    derivative = (derivative_rows(fit, place[:1]) @ fit.pseudoinverse)[0, 0] / model.half
    rivals = np.zeros((c, u, 0), complex) if used.size else _rival_spread(response, model, query_frequency, value)
    if fit.orders.denominator == 0:
        return _LineWeights(index, value, derivative, rivals)
    noise = np.einsum("kce,kuv->kcuev", response.channel_covariance[index], response.load_covariance[index])
    noise = noise.reshape(len(index), c * u, c * u) / (sigma[:, None] * sigma)
    shifts = pole_uncertainty(fit, place, noise)[:, :, 0] * sigma[:, None]
    shift = shifts[0] - np.tensordot(shares[used], shifts[1:], axes=1)
    return _LineWeights(index, value, derivative, np.concatenate([shift.reshape(c, u, -1), rivals], axis=2))


def _rival_spread(
    response: FrequencyResponse, model: WindowModel, query_frequency: float, value: ComplexArray
) -> ComplexArray:
    """Standard deviations (c, u, s) that models add which the lines of a window hardly tell from the best one.

    A pole that noise makes beside a mode gains little over a model without it, and sigma of either knows only its own.
    """
    lines, place = response.response[model.index], np.atleast_1d(model.position(query_frequency))
    columns = [
        np.sqrt(rival.weight)
        * np.tensordot((response_rows(rival.fit, place) @ rival.fit.pseudoinverse)[0, 0] - value, lines, axes=1)
        for rival in model.rivals
    ]
    return np.stack(columns, axis=2) if columns else np.zeros((*lines.shape[1:], 0), complex)


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
