"""Residuals of linear least squares on measured lines, with derivatives, and the selection of these lines.

They serve the starting values of a fit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Beyond this number of lines every second, third ... is used: starting values need no more accuracy.
MAX_START_LINES = 600
# Added to the unit diagonal of normal equations, so that dependent columns can be solved; far above rounding, 2e-16.
RIDGE = 1e-13


@dataclass(frozen=True)
class RegressionResidual:
    """Errors (K, m) of K lines, and a function for their derivatives (K, m, p), which are not always needed."""

    error: ComplexArray
    jacobian: Callable[[], ComplexArray]


def line_stride(batches: Sequence[Batch], max_frequency: float = np.inf, max_lines: int = MAX_START_LINES) -> int:
    """The stride at which about `max_lines` of the lines up to `max_frequency` [Hz] are left."""
    lines = sum(int(np.sum(batch.line_frequency <= max_frequency)) for batch in batches)
    return 1 + lines // max_lines


def every_nth_line(batch: Batch, stride: int, max_frequency: float = np.inf) -> NDArray[np.intp]:
    """Indices of every `stride`-th line up to `max_frequency` [Hz], and of all the few lines at frequency zero."""
    frequency = batch.line_frequency
    below = np.flatnonzero(frequency <= max_frequency)
    return np.asarray(below[(frequency[below] == 0) | (np.arange(len(below)) % stride == 0)])


def batched_least_squares(matrix: ComplexArray | Array, right: ComplexArray | Array) -> ComplexArray:
    """Least squares (K, n, r) of matrices (K, m, n) with scaled columns, by the normal equations.

    These are accurate enough for starting values.
    """
    size = np.sqrt(np.sum(np.abs(matrix) ** 2, axis=1))
    scaled = matrix / np.where(size > 0, size, 1.0)[:, None, :]
    transposed = scaled.conj().swapaxes(1, 2)
    normal = np.matmul(transposed, scaled)
    normal[:, range(normal.shape[1]), range(normal.shape[1])] += RIDGE
    return np.asarray(np.linalg.solve(normal, np.matmul(transposed, right)) / np.where(size > 0, size, 1.0)[:, :, None])
