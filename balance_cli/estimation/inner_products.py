"""Real inner products of complex arrays, which chi-square and its derivatives are made of."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


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
