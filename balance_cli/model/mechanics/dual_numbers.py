"""Arrays that carry their derivatives: first-order jets, so that the model's code reads like its equations.

A jet holds `value` (...) and `slope` (p, ...), the derivatives with respect to p parameters. The rules are those of
calculus (forward accumulation), so derivatives are analytic to rounding. Jets hold the small matrices of the model;
what depends on frequency is formed from them in closed form (see `model.response`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Operand = "Jet | ArrayLike"


@dataclass(frozen=True, eq=False)
class Jet:
    """A real array with its derivatives: `value` of any shape, `slope` (p, *value.shape)."""

    value: Array
    slope: Array

    # Numpy must leave `array @ jet` and `array * jet` to the methods below.
    __array_ufunc__ = None

    @property
    def parameters(self) -> int:
        """Number p of parameters that the slope refers to."""
        return int(self.slope.shape[0])

    @property
    def T(self) -> Jet:
        """Transpose of a matrix."""
        return Jet(self.value.T, np.swapaxes(self.slope, -1, -2))

    def __getitem__(self, index: Any) -> Jet:
        """Elements or blocks; the index refers to the value."""
        index = index if isinstance(index, tuple) else (index,)
        return Jet(self.value[index], self.slope[(slice(None), *index)])

    def _like(self, other: Jet | ArrayLike) -> Jet:
        return other if isinstance(other, Jet) else constant(other, self.parameters)

    def __add__(self, other: Jet | ArrayLike) -> Jet:
        that = self._like(other)
        value = self.value + that.value
        return Jet(value, _aligned(self, value.ndim) + _aligned(that, value.ndim))

    __radd__ = __add__

    def __neg__(self) -> Jet:
        return Jet(-self.value, -self.slope)

    def __sub__(self, other: Jet | ArrayLike) -> Jet:
        return self + (-self._like(other))

    def __rsub__(self, other: Jet | ArrayLike) -> Jet:
        return self._like(other) + (-self)

    def __mul__(self, other: Jet | ArrayLike) -> Jet:
        that = self._like(other)
        value = self.value * that.value
        slope = _aligned(self, value.ndim) * that.value + self.value * _aligned(that, value.ndim)
        return Jet(value, slope)

    __rmul__ = __mul__

    def __matmul__(self, other: Jet | ArrayLike) -> Jet:
        that = self._like(other)
        return Jet(self.value @ that.value, _slope_matmul(self.slope, that.value) + _matmul_slope(self.value, that))

    def __rmatmul__(self, other: ArrayLike) -> Jet:
        return self._like(other) @ self

    def reciprocal(self) -> Jet:
        """1 / self, element by element."""
        value = 1.0 / self.value
        return Jet(value, -(value**2) * self.slope)

    def sqrt(self) -> Jet:
        """Square root, element by element."""
        value: Array = np.sqrt(self.value)
        return Jet(value, 0.5 * self.slope / value)

    def expanded(self, axis: int) -> Jet:
        """A new axis of length one; `axis` counts as in the value, negative from its end."""
        at = axis if axis < 0 else axis + 1
        return Jet(np.expand_dims(self.value, axis), np.expand_dims(self.slope, at))

    def dot(self, array: Array) -> Jet:
        """Sum over the last axis with the first of a constant array."""
        return Jet(np.tensordot(self.value, array, 1), np.tensordot(self.slope, array, 1))

    def inverse(self) -> Jet:
        """Inverse of a square matrix: d(A^-1) = -A^-1 dA A^-1."""
        value = np.asarray(np.linalg.inv(self.value), float)
        return Jet(value, -value @ self.slope @ value)


def _aligned(jet: Jet, ndim: int) -> Array:
    """The slope with axes inserted, so that it broadcasts like a value of `ndim` axes."""
    missing = ndim - jet.value.ndim
    return jet.slope.reshape(jet.parameters, *(1,) * missing, *jet.value.shape)


def _slope_matmul(slope: Array, value: Array) -> Array:
    return slope @ value


def _matmul_slope(value: Array, that: Jet) -> Array:
    if that.value.ndim == 1:
        return np.asarray(that.slope @ value.T if value.ndim == 2 else that.slope @ value)
    return np.asarray(value @ _aligned(that, max(value.ndim, that.value.ndim)))


def constant(value: ArrayLike, parameters: int) -> Jet:
    """A jet that depends on no parameter."""
    array = np.asarray(value, float)
    return Jet(array, np.zeros((parameters, *array.shape)))


def variables(values: ArrayLike) -> Jet:
    """The parameter vector (p,) itself: its slope is the unit matrix."""
    array = np.asarray(values, float)
    return Jet(array, np.eye(array.size))


def stack(jets: Sequence[Jet]) -> Jet:
    """Jets of one shape along a new first axis."""
    return Jet(np.stack([jet.value for jet in jets]), np.stack([jet.slope for jet in jets], axis=1))


def concatenate(jets: Sequence[Jet], axis: int = 0) -> Jet:
    """Jets joined along an existing axis of the value."""
    at = axis if axis < 0 else axis + 1
    value = np.concatenate([jet.value for jet in jets], axis)
    return Jet(value, np.concatenate([jet.slope for jet in jets], at))


def block_diagonal(first: Jet, second: Jet) -> Jet:
    """Two matrices down the diagonal, zeros beside them."""
    p = first.parameters
    (a, b), (c, d) = first.value.shape, second.value.shape
    upper = concatenate([first, constant(np.zeros((a, d)), p)], axis=1)
    lower = concatenate([constant(np.zeros((c, b)), p), second], axis=1)
    return concatenate([upper, lower])
