"""Real inner products of complex arrays, which chi-square and its derivatives are made of."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

MANY_PARAMETERS = 100
"""Parameters from which those that show in one channel alone are worth operations of their own: no fit has as many."""


def real_inner_product(left: ComplexArray, right: ComplexArray) -> Array:
    """Re sum over lines and channels of left* right, (K, c, a) and (K, c, b): (a, b).

    Both are read as real numbers in pairs, so that one real product gives all parts without a conjugate copy.
    """
    a, b = left.shape[-1], right.shape[-1]
    pairs = (_real_pairs(left).T @ _real_pairs(right)).reshape(a, 2, b, 2)
    return np.asarray(pairs[:, 0, :, 0] + pairs[:, 1, :, 1])


def _real_pairs(values: ComplexArray) -> Array:
    """Columns (n, q) as (n, 2q), real and imaginary parts in turn; a view where the columns are contiguous."""
    return np.ascontiguousarray(values).reshape(-1, values.shape[-1]).view(np.float64)


def information_product(derivatives: ComplexArray, weighted: ComplexArray) -> Array:
    """Re sum dY* P dY (p, p) of derivatives dY (K, c, p) and P dY, P being Hermitian.

    A parameter that shows in one channel alone (each crosstalk of a score test does) takes the lines of this channel:
    a rig with 24 channels has a thousand parameters, of which three quarters are such.
    """
    shown = np.asarray(derivatives.any(axis=0))
    alone = np.count_nonzero(shown, axis=0) == 1
    wide = np.flatnonzero(~alone)
    product = np.empty((len(alone),) * 2)
    product[np.ix_(wide, wide)] = _stacked_parts(derivatives[:, :, wide]).T @ _stacked_parts(weighted[:, :, wide])
    for channel in range(len(shown)):
        own = np.flatnonzero(alone & shown[channel])
        rows = _stacked_parts(derivatives[:, channel, own]).T @ _stacked_parts(weighted[:, channel])
        product[own], product[:, own] = rows, rows.T
    return product


def _stacked_parts(values: ComplexArray) -> Array:
    """Columns (n, q) as (2n, q): all real parts, then all imaginary ones."""
    flat = values.reshape(math.prod(values.shape[:-1]), values.shape[-1])
    return np.concatenate([flat.real, flat.imag])
