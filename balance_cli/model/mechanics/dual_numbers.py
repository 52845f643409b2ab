"""Dual numbers: arrays that carry their first derivatives, so that the model's code reads like its equations.

A dual number holds `value` (...) and `derivative` (p, ...), the derivatives with respect to p parameters.
Differentiation is forward-mode (Griewank and Walther, Evaluating Derivatives, 2nd ed., 2008, chapter 3), so the
derivatives are exact to rounding. Dual numbers hold the small matrices of the model; the frequency response is formed
from them in closed form (see `model.system`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

MANY_VALUES = 1000
"""Values of a function of time, of which a pass over all derivatives takes longer than a look at those of a factor."""


@dataclass(frozen=True, eq=False)
class Dual:
    """A real array with its derivatives: `value` of any shape, `derivative` (p, *value.shape)."""

    value: Array
    derivative: Array

    # NumPy must leave `array @ dual` and `array * dual` to the methods below.
    __array_ufunc__ = None

    @property
    def parameters(self) -> int:
        """Number p of parameters that the derivative refers to."""
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
        if not isinstance(other, Dual):
            value = self.value + np.asarray(other, float)
            shape = (self.parameters, *value.shape)
            return Dual(value, np.array(np.broadcast_to(_align_derivative(self, value.ndim), shape)))
        that = other
        value = self.value + that.value
        return Dual(value, _align_derivative(self, value.ndim) + _align_derivative(that, value.ndim))

    __radd__ = __add__

    def __neg__(self) -> Dual:
        return Dual(-self.value, -self.derivative)

    def __sub__(self, other: Dual | ArrayLike) -> Dual:
        that = self._as_dual(other)
        value = self.value - that.value
        return Dual(value, _align_derivative(self, value.ndim) - _align_derivative(that, value.ndim))

    def __rsub__(self, other: Dual | ArrayLike) -> Dual:
        return self._as_dual(other) + (-self)

    def __mul__(self, other: Dual | ArrayLike) -> Dual:
        if not isinstance(other, Dual):
            # Of many parameters the derivative of a constant, all zeros, takes longer than the product.
            factor = np.asarray(other, float)
            value = self.value * factor
            return Dual(value, _align_derivative(self, value.ndim) * factor)
        that = other
        if that.value.ndim == 0 and self.value.size >= MANY_VALUES:
            return _times_number(self, that)
        if self.value.ndim == 0 and that.value.size >= MANY_VALUES:
            return _times_number(that, self)
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

    def exp(self) -> Dual:
        """Exponential, element by element."""
        value: Array = np.exp(self.value)
        return Dual(value, self.derivative * value)

    def insert_axis(self, axis: int) -> Dual:
        """A new axis of length one; `axis` counts as in the value, negative from its end."""
        shape = list(self.value.shape)
        shape.insert(axis if axis >= 0 else len(shape) + 1 + axis, 1)
        return Dual(self.value.reshape(shape), self.derivative.reshape(self.parameters, *shape))

    def dot(self, array: Array) -> Dual:
        """Product summed over the last axis and the first axis of a constant array."""
        return Dual(np.tensordot(self.value, array, 1), np.tensordot(self.derivative, array, 1))

    def inverse(self) -> Dual:
        """Inverse of a square matrix: d(A^-1) = -A^-1 dA A^-1."""
        value = np.asarray(np.linalg.inv(self.value), float)
        return Dual(value, -value @ self.derivative @ value)


def _times_number(array: Dual, number: Dual) -> Dual:
    """The product of an array of many values and a number, which few of the parameters change."""
    derivative = array.derivative * number.value
    for parameter in np.flatnonzero(number.derivative):
        derivative[parameter] += array.value * number.derivative[parameter]
    return Dual(array.value * number.value, derivative)


def _align_derivative(dual: Dual, ndim: int) -> Array:
    """The derivative with axes inserted, so that it broadcasts like a value of `ndim` axes."""
    missing = ndim - dual.value.ndim
    return dual.derivative.reshape(dual.parameters, *(1,) * missing, *dual.value.shape)


def _derivative_matmul(derivative: Array, value: Array) -> Array:
    return derivative @ value


def _matmul_derivative(value: Array, that: Dual) -> Array:
    if that.value.ndim == 1:
        return np.asarray(that.derivative @ value.T if value.ndim == 2 else that.derivative @ value)
    return np.asarray(value @ _align_derivative(that, max(value.ndim, that.value.ndim)))


def constant(value: ArrayLike, parameters: int) -> Dual:
    """A dual number that depends on no parameter."""
    array = np.asarray(value, float)
    return Dual(array, np.zeros((parameters, *array.shape)))


def variables(values: ArrayLike) -> Dual:
    """The parameter vector (p,) itself; its derivative is the unit matrix."""
    array = np.asarray(values, float)
    return Dual(array, np.eye(array.size))


def stack(duals: Sequence[Dual]) -> Dual:
    """Dual numbers of one shape, stacked along a new first axis."""
    return Dual(np.stack([dual.value for dual in duals]), np.stack([dual.derivative for dual in duals], axis=1))


def concatenate(duals: Sequence[Dual], axis: int = 0) -> Dual:
    """Dual numbers joined along an existing axis of the value."""
    at = axis if axis < 0 else axis + 1
    value = np.concatenate([dual.value for dual in duals], axis)
    return Dual(value, np.concatenate([dual.derivative for dual in duals], at))


def block_diagonal(first: Dual, second: Dual) -> Dual:
    """The block-diagonal matrix of two matrices."""
    p = first.parameters
    (a, b), (c, d) = first.value.shape, second.value.shape
    upper = concatenate([first, constant(np.zeros((a, d)), p)], axis=1)
    lower = concatenate([constant(np.zeros((c, b)), p), second], axis=1)
    return concatenate([upper, lower])


def clip_below(dual: Dual, floor: float | Array) -> Dual:
    """The dual number, replaced by `floor` without derivative where it is smaller.

    This keeps square roots and reciprocals regular at zero.
    """
    above = dual.value > floor
    return Dual(np.maximum(dual.value, floor), dual.derivative * above)
