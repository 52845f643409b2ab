"""Linear independence of the columns of a matrix, such as the response to each load, but for rounding."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Matrices = NDArray[np.float64] | NDArray[np.complex128]

LARGEST_CONDITION = 1e8
"""Condition from which columns count as dependent: double precision then leaves eight digits of a solution."""


def negligible_columns(matrices: Matrices, scale: ArrayLike = 1.0) -> NDArray[np.bool_]:
    """Return which columns (m,) of a matrix (r, m), or of one or more of n (n, r, m), are zero but for rounding.

    The columns over `scale` (m,) are comparable. A column that is zero in exact arithmetic is not zero as computed, and
    the condition of columns of unit norm does not show it.
    """
    norms = np.linalg.norm(matrices, axis=-2) / np.asarray(scale, float)
    negligible = norms <= norms.max(axis=-1, keepdims=True) / LARGEST_CONDITION
    return np.asarray(np.any(np.atleast_2d(negligible), axis=0))


def has_independent_columns(matrices: Matrices, scale: ArrayLike = 1.0) -> bool:
    """Whether the columns of a matrix (r, m), or of each of n (n, r, m), are independent; `scale` as above."""
    rows, columns = matrices.shape[-2:]
    if rows < columns or np.any(negligible_columns(matrices, scale)):
        return False
    norms = np.linalg.norm(matrices, axis=-2, keepdims=True)
    return bool(np.all(np.linalg.cond(matrices / norms) < LARGEST_CONDITION))
