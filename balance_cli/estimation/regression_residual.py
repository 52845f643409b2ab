"""What linear least squares leaves of measured lines, with slopes, and which lines it takes; serves for a start."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# A start needs no more lines; beyond this number every second, third .. line serves.
MAX_START_LINES = 600


@dataclass(frozen=True)
class RegressionResidual:
    """Errors (K, m) of K lines, and how to get their slopes (K, m, p), which are not always asked for."""

    error: ComplexArray
    jacobian: Callable[[], ComplexArray]


def line_stride(batches: Sequence[Batch], max_frequency: float = np.inf, max_lines: int = MAX_START_LINES) -> int:
    """Which lines up to `highest` [Hz] are enough: every one, every second ..."""
    lines = sum(int(np.sum(batch.line_frequency <= max_frequency)) for batch in batches)
    return 1 + lines // max_lines


def every_nth_line(batch: Batch, stride: int, max_frequency: float = np.inf) -> NDArray[np.intp]:
    """Every `stride`-th line up to `highest` [Hz]; all at frequency zero, which are few."""
    frequency = batch.line_frequency
    below = np.flatnonzero(frequency <= max_frequency)
    return np.asarray(below[(frequency[below] == 0) | (np.arange(len(below)) % stride == 0)])


def precision(batch: Batch) -> Array:
    """One over the variances (K, c) of the channels; zero where one is not live."""
    c = batch.lines.channels.shape[1]
    return np.real(np.diagonal(batch.lines.precision[:, :c, :c], axis1=1, axis2=2))


def batched_least_squares(matrix: ComplexArray | Array, right: ComplexArray | Array) -> ComplexArray:
    """Least squares (K, n, r) of matrices (K, m, n), columns scaled; by the normal equations, as a start allows."""
    size = np.sqrt(np.sum(np.abs(matrix) ** 2, axis=1))
    scaled = matrix / np.where(size > 0, size, 1.0)[:, None, :]
    transposed = scaled.conj().swapaxes(1, 2)
    normal = np.matmul(transposed, scaled)
    normal[:, range(normal.shape[1]), range(normal.shape[1])] += 1e-13
    return np.asarray(np.linalg.solve(normal, np.matmul(transposed, right)) / np.where(size > 0, size, 1.0)[:, :, None])
