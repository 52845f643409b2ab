"""A measured response between its lines.

METHODS: `local` fits a rational function with poles common to all channels through the neighbouring lines, weighted
with their covariance; `spline` is the cubic spline through the lines; `first-order` is T + dT/df (f - f0) from the
nearest line, as the paper has it (section 4), with the derivative from its two neighbours; `nearest` is that line.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.io.errors import UserError
from balance_cli.signals.local_fit import LocalFit, Orders, Windows, fit_windows
from balance_cli.signals.local_window import WindowFit, influence, pole_shift, response_rows, slope_rows, split
from balance_cli.signals.run_spectrum import Response

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

METHODS = ("local", "spline", "first-order", "nearest")
LOCAL_LINES = 11
SPLINE_LINES = 12
ORDERS = tuple(Orders(degree, -1, poles) for degree in (1, 2, 3) for poles in (0, 1, 2, 3))
LEAST_SIGMA = 1e-9


@dataclass(frozen=True)
class ResponseAt:
    """Response at h frequencies: value (h, c, u), derivative (h, c, u) per Hz, and the covariance of the value,

    separable as in `Response`: channel_covariance (h, c, c), load_covariance (h, u, u). Without h for one frequency.
    """

    value: ComplexArray
    derivative: ComplexArray
    channel_covariance: ComplexArray
    load_covariance: ComplexArray


@dataclass(frozen=True)
class _Weights:
    """The response as a weighted sum of lines: index (M,), weights of value and derivative (M,), and what the poles'

    uncertainty adds: standard deviations (c, u, s).
    """

    index: Index
    value: ComplexArray
    derivative: ComplexArray
    spread: ComplexArray


def response_at(response: Response, frequency: float | Array, method: str = "local") -> ResponseAt:
    """The response at `frequency` [Hz], a number or (h,), by one of METHODS. UserError outside the measured lines."""
    asked = np.atleast_1d(np.asarray(frequency, float))
    _check_range(response, asked)
    weights = _RULES[method](response, asked)
    each = [_combined(response, one) for one in weights]
    arrays = [np.stack(parts) for parts in zip(*each, strict=True)]
    return ResponseAt(*arrays) if np.ndim(frequency) else ResponseAt(*(part[0] for part in arrays))


def values_at(response: Response, frequency: Array, method: str = "local") -> ComplexArray:
    """The response (h, c, u) alone at many frequencies (h,) [Hz], by one of METHODS; see `response_at`.

    A local model is fitted once between each two lines and serves all frequencies there.
    """
    asked = np.asarray(frequency, float)
    if method != "local" or len(response.frequency) < 5:
        return response_at(response, asked, method).value
    _check_range(response, asked)
    index = _nearest(response, asked, LOCAL_LINES)
    starts, gap = np.unique(index[:, 0], return_inverse=True)
    windows_of = starts[:, None] + np.arange(index.shape[1])
    centre = np.array([asked[gap == g].mean() for g in range(len(starts))])
    fits, half, _ = _best_fits(response, windows_of, centre)
    values = np.empty((len(asked), *response.response.shape[1:]), complex)
    for g, fit in enumerate(fits):
        mine = np.flatnonzero(gap == g)
        weights = (response_rows(fit, (asked[mine] - centre[g]) / half[g]) @ influence(fit))[:, 0]
        values[mine] = np.tensordot(weights, response.response[windows_of[g]], axes=1)
    return values


def _check_range(response: Response, asked: Array) -> None:
    lines = response.frequency
    slack = np.max(np.diff(lines)) if len(lines) > 1 else 0.0
    outside = asked[(asked < lines[0] - slack) | (asked > lines[-1] + slack)]
    if outside.size:
        raise UserError(
            f"the response to {', '.join(response.components)} was measured from {lines[0]:g} to {lines[-1]:g} Hz, "
            f"not at {outside[0]:g} Hz",
            f"run {response.run}",
            remedy="Sweep further, or ask for fewer harmonics",
        )


def _nearest(response: Response, asked: Array, count: int) -> Index:
    """The `count` lines (h, count) around each frequency; at the ends of the band those at the end."""
    K = len(response.frequency)
    count = min(count, K)
    above = np.searchsorted(response.frequency, asked)
    start = np.clip(above - count // 2, 0, K - count)
    return np.asarray(start[:, None] + np.arange(count))


def _closest(response: Response, asked: Array) -> Index:
    return np.asarray(np.argmin(np.abs(response.frequency - asked[:, None]), axis=1))


def _plain(response: Response, index: Index, value: Array, derivative: Array) -> _Weights:
    none = np.zeros((*response.response.shape[1:], 0), complex)
    return _Weights(index, value.astype(complex), derivative.astype(complex), none)


def _by_nearest(response: Response, asked: Array) -> list[_Weights]:
    return [_plain(response, np.array([k]), np.ones(1), np.zeros(1)) for k in _closest(response, asked)]


def _by_first_order(response: Response, asked: Array) -> list[_Weights]:
    K = len(response.frequency)
    result = []
    for k, f in zip(_closest(response, asked), asked, strict=True):
        index = np.clip(k - 1, 0, max(K - 3, 0)) + np.arange(min(3, K))
        here = np.asarray(index == k, float)
        slope = _parabola_slope(response.frequency[index], response.frequency[k])
        result.append(_plain(response, index, here + (f - response.frequency[k]) * slope, slope))
    return result


def _parabola_slope(x: Array, at: float) -> Array:
    """Weights (n,) of the derivative at `at` of the polynomial through n points x (Lagrange)."""
    powers = np.vander(x - at, increasing=True)
    return np.asarray(np.linalg.inv(powers)[1] if len(x) > 1 else np.zeros(1))


def _by_spline(response: Response, asked: Array) -> list[_Weights]:
    from scipy.interpolate import make_interp_spline

    result = []
    for index, f in zip(_nearest(response, asked, SPLINE_LINES), asked, strict=True):
        degree = min(3, len(index) - 1)
        spline = make_interp_spline(response.frequency[index], np.eye(len(index)), k=degree)
        slope = spline.derivative()(f) if degree else np.zeros(1)
        result.append(_plain(response, index, np.asarray(spline(f)), np.asarray(slope)))
    return result


def _by_local(response: Response, asked: Array) -> list[_Weights]:
    """Rational functions, their orders chosen by Akaike's criterion with the known noise: V + 2 p."""
    index = _nearest(response, asked, LOCAL_LINES)
    if index.shape[1] < 5:
        return _by_spline(response, asked)
    fits, half, sigma = _best_fits(response, index, asked)
    return [_local_weights(response, index[h], fits[h], half[h], sigma[h]) for h in range(len(asked))]


def _best_fits(response: Response, index: Index, centre: Array) -> tuple[list[WindowFit], Array, Array]:
    """The best local model of each window (h, M) of lines about its `centre` (h,) [Hz]; half-widths; sigma (h, c u)."""
    offset = response.frequency[index] - centre[:, None]
    half = np.max(np.abs(offset), axis=1)
    windows, sigma = _windows(response, index, offset / half[:, None])
    candidates = [orders for orders in ORDERS if orders.response + orders.denominator + 2 < index.shape[1]]
    fits = [fit_windows(windows, orders) for orders in candidates]
    best = np.argmin([_akaike(windows, fit) for fit in fits], axis=0)
    each = [split(fit, windows) for fit in fits]
    return [each[best[h]][h] for h in range(len(centre))], half, sigma


def _windows(response: Response, index: Index, r: Array) -> tuple[Windows, Array]:
    """Every channel and component as an output (h, M, c u) in units of its own noise (h, c u), of a unit input."""
    c, u = response.response.shape[1:]
    values = response.response[index].reshape(*index.shape, c * u)
    channels = np.diagonal(response.channel_covariance, axis1=1, axis2=2).real
    loads = np.diagonal(response.load_covariance, axis1=1, axis2=2).real
    variance = (channels[:, :, None] * loads[:, None, :]).reshape(-1, c * u)[index]
    size = np.max(np.abs(values), axis=1)
    sigma = np.maximum(np.sqrt(np.median(variance, axis=1)), LEAST_SIGMA * np.where(size > 0, size, 1.0))
    level = np.maximum(np.mean(variance / sigma[:, None, :] ** 2, axis=2), 1e-3)
    ones = np.ones((*index.shape, 1), complex)
    return Windows(values / sigma[:, None, :], ones, 1.0 / np.sqrt(level), r), sigma


def _akaike(windows: Windows, fit: LocalFit) -> Array:
    outputs = windows.Y.shape[2]
    return np.asarray(fit.cost + 2.0 * (outputs * fit.orders.coefficients(1) + fit.orders.denominator), float)


def _local_weights(response: Response, index: Index, fit: WindowFit, half: float, sigma: Array) -> _Weights:
    """Weights at the middle of the window, and the spread by its poles."""
    c, u = response.response.shape[1:]
    middle = np.zeros(1)
    S = influence(fit)
    value, derivative = (response_rows(fit, middle) @ S)[0, 0], (slope_rows(fit, middle) @ S)[0, 0] / half
    if fit.orders.denominator == 0:
        return _Weights(index, value, derivative, np.zeros((c, u, 0), complex))
    noise = np.einsum("kce,kuv->kcuev", response.channel_covariance[index], response.load_covariance[index])
    noise = noise.reshape(len(index), c * u, c * u) / (sigma[:, None] * sigma)
    shift = pole_shift(fit, middle, noise)[0, :, 0] * sigma[:, None]
    return _Weights(index, value, derivative, shift.reshape(c, u, -1))


def _combined(response: Response, weights: _Weights) -> tuple[ComplexArray, ...]:
    """Value, derivative, and the two factors of the covariance, the loads' from the line that weighs most."""
    lines = response.response[weights.index]
    value = np.tensordot(weights.value, lines, axes=1)
    derivative = np.tensordot(weights.derivative, lines, axes=1)
    main = weights.index[np.argmax(np.abs(weights.value))]
    loads = response.load_covariance[main]
    precision = np.linalg.inv(loads)
    u = len(loads)
    relative = np.einsum("kuv,vu->k", response.load_covariance[weights.index], precision).real / u
    share = _shares(response, weights.value) * relative
    channels = np.tensordot(share, response.channel_covariance[weights.index], axes=1)
    spread = np.einsum("cua,uv,dva->cd", weights.spread, precision, weights.spread.conj()) / u
    return value, derivative, channels + spread, loads


def _shares(response: Response, weights: ComplexArray) -> Array:
    """How each line's covariance counts: lines of periodic records are independent, those of windows that slide or

    overlap share their noise, so that averaging over them gains nothing.
    """
    size = np.abs(weights)
    return size**2 if response.estimator.startswith("periodic") else size / size.sum()


_RULES: dict[str, Callable[[Response, Array], list[_Weights]]] = {
    "local": _by_local,
    "spline": _by_spline,
    "first-order": _by_first_order,
    "nearest": _by_nearest,
}
