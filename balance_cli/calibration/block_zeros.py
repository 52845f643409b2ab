"""Zeros of blocks of rows, eliminated from a weighted regression: each block has a mean of its own."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class BlockZeros:
    """Zeros of blocks of rows, for elimination from weighted rows.

    `place` (m,): block of each row; `order` (m,) sorts the rows by block and `starts` (b,) are the first rows of the
    blocks in that order; `total` (b,): sum of the weights; `root` (m,): square roots of the weights.
    """

    place: Index
    order: Index
    starts: Index
    total: Array
    root: Array

    @classmethod
    def from_blocks(cls, block: Index, weight: Array) -> BlockZeros:
        """Return the zeros of the blocks that `block` (m,) names, with the weights (m,) of the rows."""
        names, place = np.unique(block, return_inverse=True)
        order = np.argsort(place, kind="stable")
        starts = np.searchsorted(place[order], np.arange(len(names)))
        return cls(place, order, starts, np.asarray(np.bincount(place, weight), float), np.sqrt(weight))

    def with_weight(self, weight: Array) -> BlockZeros:
        """Return the zeros of the same blocks for other weights (m,) of the rows."""
        return replace(self, total=np.asarray(np.bincount(self.place, weight), float), root=np.sqrt(weight))

    def sums(self, rows: NDArray[np.floating]) -> NDArray[np.floating]:
        """Product D' A (b, p) of weighted rows A (m, p), with D (m, b) the weighted columns of the zeros."""
        weighted = rows * self.root[:, None]
        return np.asarray(np.add.reduceat(weighted[self.order], self.starts, axis=0))

    def expand(self, values: NDArray[np.floating]) -> NDArray[np.floating]:
        """Product D V (m, p) of values V (b, p) of the blocks."""
        return np.asarray(values[self.place] * self.root[:, None])

    def means(self, rows: NDArray[np.floating]) -> NDArray[np.floating]:
        """Weighted mean (b, p) of the rows in each block, from weighted rows (m, p)."""
        return np.asarray(self.sums(rows) / self.total[:, None])

    def subtract_means(self, values: NDArray[np.floating]) -> NDArray[np.floating]:
        """Weight the rows of values (m, p) and subtract their block means."""
        rows = values * self.root[:, None]
        return np.asarray(rows - self.expand(self.means(rows)))


def subtract_block_means(values: Array, block: Index, weight: Array | None = None) -> Array:
    """Weight the rows of values (m, p) and subtract their weighted mean in each block (m,)."""
    w = np.ones(len(values)) if weight is None else weight
    return np.asarray(BlockZeros.from_blocks(block, w).subtract_means(values), float)


def subtract_mean(readings: Array) -> Array:
    """Return readings (r, c) of a load series less their mean: the zero of a series is its own."""
    return np.asarray(readings - readings.mean(axis=0))
