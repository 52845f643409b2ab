"""Whether a response determines the loads: linearly independent columns, none of them zero but for rounding."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LARGEST_CONDITION = 1e8
"""Condition above which a response is refused as singular: double precision then leaves eight digits of the loads."""


def loads_without_response(T: ComplexArray, scale: Array) -> NDArray[np.bool_]:
    """Return which loads (m,) the rows of T (k, r, m) do not feel at one of k frequencies, but for rounding.

    `scale` (m,) makes the loads comparable (`response_sources.load_scale`). A response that is zero in exact arithmetic
    is not zero as computed, and the condition of columns of unit norm does not show it.
    """
    norms = np.linalg.norm(T, axis=1) / scale
    return np.asarray(np.any(norms <= norms.max(axis=1, keepdims=True) / LARGEST_CONDITION, axis=0))


def determines_all_loads(T: ComplexArray, scale: Array) -> bool:
    """Whether the rows of T (k, r, m) determine all m loads at each of k frequencies."""
    if T.shape[1] < T.shape[2] or np.any(loads_without_response(T, scale)):
        return False
    norms = np.linalg.norm(T, axis=1, keepdims=True)
    return bool(np.all(np.linalg.cond(T / norms) < LARGEST_CONDITION))
