"""Interpolating splines of any odd degree, as piecewise polynomials.

`scipy.interpolate` has them too, but it imports `scipy.optimize` and `scipy.spatial`, which together take longer than
the reduction of a run. The knots are the points but for the outer ones (not-a-knot), as in `make_interp_spline`.
Source: C. de Boor, A Practical Guide to Splines, 2001, chapters IX, X and XIII.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_banded

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Numbers = NDArray[Any]

KEPT = 512
"""Polynomials of which twice as many are formed at once: so many take no longer than the calls that form a few."""


@dataclass(frozen=True)
class PiecewisePolynomial:
    """Polynomials between `breaks` (m + 1,); `coefficients` (k + 1, m, ...) of rising powers of x less the break below.

    The outer polynomials continue beyond the breaks.
    """

    breaks: Array
    coefficients: Numbers

    def __call__(self, x: ArrayLike) -> Numbers:
        """Return the values (..., *) at x (...)."""
        points = np.asarray(x, float)
        index, offset = self.locate(points.ravel())
        column = offset.reshape(-1, *(1,) * (self.coefficients.ndim - 2))
        value = self.coefficients[-1][index]
        for coefficient in self.coefficients[-2::-1]:
            value *= column
            value += coefficient[index]
        return np.reshape(value, points.shape + value.shape[1:])

    def with_slope(self, x: ArrayLike) -> tuple[Numbers, Numbers]:
        """Return values (...) and slopes (...) at x (...) of a spline without further axes: both from one search."""
        points = np.asarray(x, float)
        index, offset = self.locate(points.ravel())
        value = self.coefficients[-1][index]
        slope = value * (len(self.coefficients) - 1)
        for power in range(len(self.coefficients) - 2, -1, -1):
            coefficient = self.coefficients[power][index]
            value *= offset
            value += coefficient
            if power:
                slope *= offset
                slope += coefficient * power
        return value.reshape(points.shape), slope.reshape(points.shape)

    def derivative(self) -> PiecewisePolynomial:
        """Return the derivative; that of constants is zero."""
        if len(self.coefficients) == 1:
            return PiecewisePolynomial(self.breaks, np.zeros_like(self.coefficients))
        power = np.arange(1, len(self.coefficients)).reshape(-1, *(1,) * (self.coefficients.ndim - 1))
        return PiecewisePolynomial(self.breaks, self.coefficients[1:] * power)

    def locate(self, x: Array) -> tuple[Index, Array]:
        """Return the polynomial of each x (n,), and x less the break below it."""
        index = np.clip(np.searchsorted(self.breaks, x, "right") - 1, 0, len(self.breaks) - 2)
        return index, x - self.breaks[index]


@dataclass(frozen=True)
class Spline:
    """A spline as a sum of B-splines, a quarter of the numbers of cubic polynomials.

    `knots` (n + degree + 1,), `controls` (n, ...).
    """

    knots: Array
    controls: Numbers
    degree: int
    _kept: dict[tuple[int, int], PiecewisePolynomial] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @property
    def breaks(self) -> Array:
        """Where its polynomials meet, with both ends."""
        return self.knots[self.degree : len(self.knots) - self.degree]

    def between(self, first: float, last: float) -> PiecewisePolynomial:
        """Return its polynomials from that at `first` to that at `last`, and some around them, which are kept."""
        edges = self.breaks
        low, high = np.clip(np.searchsorted(edges, [first, last], "right") - 1, 0, len(edges) - 2)
        begin, end = low - low % KEPT, max(low - low % KEPT + 2 * KEPT, high + 1)
        if (begin, end) not in self._kept:
            knots, controls = self.knots[begin : end + 1 + 2 * self.degree], self.controls[begin : end + self.degree]
            self._kept.clear()
            self._kept[begin, end] = Spline(knots, controls, self.degree).polynomials()
        return self._kept[begin, end]

    def polynomials(self) -> PiecewisePolynomial:
        """Return its polynomials."""
        degree, knots, breaks = self.degree, self.knots, self.breaks
        controls = self.controls.reshape(len(self.controls), -1)
        coefficients = np.empty((degree + 1, len(breaks) - 1, controls.shape[1]), controls.dtype)
        start = np.arange(degree, degree + len(breaks) - 1)
        for order in range(degree + 1):
            basis = _basis(breaks[:-1], knots, start, degree - order)
            near = controls[start[:, None] - degree + np.arange(degree - order + 1)]
            coefficients[order] = np.einsum("mj,mjs->ms", basis, near) / math.factorial(order)
            if order < degree:
                controls = _differentiate(controls, knots, degree, order)
        shape = (*coefficients.shape[:2], *self.controls.shape[1:])
        return PiecewisePolynomial(breaks, coefficients.reshape(shape))


def interpolating_spline(x: ArrayLike, y: ArrayLike, degree: int) -> PiecewisePolynomial:
    """Return the polynomials of the spline through the points x (n,), rising, and y (n, ...), real or complex.

    `degree` is odd. Fewer than `degree` + 1 points have the polynomial through all of them.
    """
    return spline_through(x, y, degree).polynomials()


def spline_through(x: ArrayLike, y: ArrayLike, degree: int) -> Spline:
    """Return the same as B-splines."""
    points, values = np.asarray(x, float), np.asarray(y)
    degree = min(degree, len(points) - 1)
    outside = (degree + 1) // 2
    inner = points[outside : len(points) - outside] if len(points) > degree + 1 else points[:0]
    knots = np.concatenate([np.repeat(points[0], degree + 1), inner, np.repeat(points[-1], degree + 1)])
    controls = _control_points(points, values.reshape(len(points), -1), knots, degree)
    return Spline(knots, controls.reshape(values.shape), degree)


def _control_points(x: Array, y: Numbers, knots: Array, degree: int) -> Numbers:
    """Return the coefficients (n, s) of the B-splines by which the spline is y at x."""
    n = len(x)
    interval = np.clip(np.searchsorted(knots, x, "right") - 1, degree, n - 1)
    basis = _basis(x, knots, interval, degree)
    banded = np.zeros((2 * degree + 1, n))
    row, column = np.arange(n)[:, None], interval[:, None] - degree + np.arange(degree + 1)
    banded[degree + row - column, column] = basis
    return np.asarray(solve_banded((degree, degree), banded, y))


def _basis(x: Array, knots: Array, interval: Index, degree: int) -> Array:
    """Return the B-splines (n, degree + 1) that do not vanish in the interval of each x (de Boor, algorithm X.8)."""
    values = np.ones((len(x), 1))
    for k in range(1, degree + 1):
        reach = np.arange(1, k + 1)
        right = knots[interval[:, None] + reach] - x[:, None]
        left = x[:, None] - knots[interval[:, None] + reach - k]
        share = values / (right + left)
        values = np.zeros((len(x), k + 1))
        values[:, :-1] = right * share
        values[:, 1:] += left * share
    return values


def _differentiate(controls: Numbers, knots: Array, degree: int, order: int) -> Numbers:
    """Return the coefficients of the next derivative, from those (n, s) of the derivative of this order."""
    k = degree - order
    n = len(controls)
    width = knots[degree + 1 : degree + n] - knots[order + 1 : order + n]
    return np.asarray(k * np.diff(controls, axis=0) / width[:, None])
