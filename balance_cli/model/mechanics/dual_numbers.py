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
class Dual:
    """A real array with its derivatives: `value` of any shape, `slope` (p, *value.shape)."""

    value: Array
    derivative: Array

    # Numpy must leave `array @ jet` and `array * jet` to the methods below.
    __array_ufunc__ = None

    @property
    def parameters(self) -> int:
        """Number p of parameters that the slope refers to."""
        return int(self.derivative.shape[0])

    @property
    def T(self) -> Dual:
        """Transpose of a matrix."""
        return Dual(self.value.T, np.swapaxes(self.derivative, -1, -2))

    def __getitem__(self, index: Any) -> Dual:
        """Elements or blocks; the index refers to the value."""
        index = index if isinstance(index, tuple) else (index,)
        return Dual(self.value[index], self.derivative[(slice(None), *index)])

    def _as_dual(self, other: Dual | ArrayLike) -> Dual:
        return other if isinstance(other, Dual) else constant(other, self.parameters)

    def __add__(self, other: Dual | ArrayLike) -> Dual:
        that = self._as_dual(other)
        value = self.value + that.value
        return Dual(value, _align_derivative(self, value.ndim) + _align_derivative(that, value.ndim))

    __radd__ = __add__

    def __neg__(self) -> Dual:
        return Dual(-self.value, -self.derivative)

    def __sub__(self, other: Dual | ArrayLike) -> Dual:
        return self + (-self._as_dual(other))

    def __rsub__(self, other: Dual | ArrayLike) -> Dual:
        return self._as_dual(other) + (-self)

    def __mul__(self, other: Dual | ArrayLike) -> Dual:
        that = self._as_dual(other)
        value = self.value * that.value
        derivative = _align_derivative(self, value.ndim) * that.value + self.value * _align_derivative(that, value.ndim)
        return Dual(value, derivative)

    __rmul__ = __mul__

    def __matmul__(self, other: Dual | ArrayLike) -> Dual:
        that = self._as_dual(other)
        return Dual(
            self.value @ that.value,
            _derivative_matmul(self.derivative, that.value) + _matmul_derivative(self.value, that),
        )

    def __rmatmul__(self, other: ArrayLike) -> Dual:
        return self._as_dual(other) @ self

    def reciprocal(self) -> Dual:
        """1 / self, element by element."""
        value = 1.0 / self.value
        return Dual(value, -(value**2) * self.derivative)

    def sqrt(self) -> Dual:
        """Square root, element by element."""
        value: Array = np.sqrt(self.value)
        return Dual(value, 0.5 * self.derivative / value)

    def insert_axis(self, axis: int) -> Dual:
        """A new axis of length one; `axis` counts as in the value, negative from its end."""
        at = axis if axis < 0 else axis + 1
        return Dual(np.expand_dims(self.value, axis), np.expand_dims(self.derivative, at))

    def dot(self, array: Array) -> Dual:
        """Sum over the last axis with the first of a constant array."""
        return Dual(np.tensordot(self.value, array, 1), np.tensordot(self.derivative, array, 1))

    def inverse(self) -> Dual:
        """Inverse of a square matrix: d(A^-1) = -A^-1 dA A^-1."""
        value = np.asarray(np.linalg.inv(self.value), float)
        return Dual(value, -value @ self.derivative @ value)


def _align_derivative(dual: Dual, ndim: int) -> Array:
    """The slope with axes inserted, so that it broadcasts like a value of `ndim` axes."""
    missing = ndim - dual.value.ndim
    return dual.derivative.reshape(dual.parameters, *(1,) * missing, *dual.value.shape)


def _derivative_matmul(derivative: Array, value: Array) -> Array:
    return derivative @ value


def _matmul_derivative(value: Array, that: Dual) -> Array:
    if that.value.ndim == 1:
        return np.asarray(that.derivative @ value.T if value.ndim == 2 else that.derivative @ value)
    return np.asarray(value @ _align_derivative(that, max(value.ndim, that.value.ndim)))


def constant(value: ArrayLike, parameters: int) -> Dual:
    """A jet that depends on no parameter."""
    array = np.asarray(value, float)
    return Dual(array, np.zeros((parameters, *array.shape)))


def variables(values: ArrayLike) -> Dual:
    """The parameter vector (p,) itself: its slope is the unit matrix."""
    array = np.asarray(values, float)
    return Dual(array, np.eye(array.size))


def stack(duals: Sequence[Dual]) -> Dual:
    """Jets of one shape along a new first axis."""
    return Dual(np.stack([dual.value for dual in duals]), np.stack([dual.derivative for dual in duals], axis=1))


def concatenate(duals: Sequence[Dual], axis: int = 0) -> Dual:
    """Jets joined along an existing axis of the value."""
    at = axis if axis < 0 else axis + 1
    value = np.concatenate([dual.value for dual in duals], axis)
    return Dual(value, np.concatenate([dual.derivative for dual in duals], at))


def block_diagonal(first: Dual, second: Dual) -> Dual:
    """Two matrices down the diagonal, zeros beside them."""
    p = first.parameters
    (a, b), (c, d) = first.value.shape, second.value.shape
    upper = concatenate([first, constant(np.zeros((a, d)), p)], axis=1)
    lower = concatenate([constant(np.zeros((c, b)), p), second], axis=1)
    return concatenate([upper, lower])
