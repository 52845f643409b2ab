"""The interface of a filter and smoother for one set of channels, and the blocks of samples that it passes on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from balance_cli.reduction.kalman.steady_matrices import SteadyMatrices

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FilterBlock:
    """Consecutive samples after the forward pass, from sample `first` on.

    `innovation` (n, c); `predicted` (n, m): loads U x[k] before y[k] is known; `end` (N,): x after the last sample;
    `marked` (r, q): further outputs at some of the samples, where the filter has any.
    """

    first: int
    innovation: Array
    predicted: Array
    end: Array
    marked: Array | None = None

    def with_innovations(self, later: Array) -> FilterBlock:
        """Return the block with the innovations (l, c) of the samples after it appended."""
        return replace(self, innovation=np.concatenate([self.innovation, later]))

    def superpose(self, other: FilterBlock) -> FilterBlock:
        """Return the sum of two blocks: the recursions are linear."""
        marked = None if self.marked is None or other.marked is None else self.marked + other.marked
        innovation, predicted = self.innovation + other.innovation, self.predicted + other.predicted
        return FilterBlock(self.first, innovation, predicted, self.end + other.end, marked)


@dataclass(frozen=True)
class Outputs:
    """Loads (n, m) at every sample of a block; `marked` (r, q) further outputs at some of them."""

    loads: Array
    marked: Array | None = None


@dataclass(frozen=True)
class MarkedOutputs:
    """Samples (r,) of a block, counted from its first, with further outputs of the states, `rows` (q, N).

    `filtered_variance` and `smoothed_variance` (q,) are their steady variances.
    """

    samples: NDArray[np.intp]
    rows: Array
    filtered_variance: Array
    smoothed_variance: Array


class ChannelFilter(Protocol):
    """A filter and its smoother for one set of channels, block by block."""

    @property
    def time_invariant(self) -> bool:
        """Whether the matrices are the same at all times."""
        ...

    def at(self, first: int, count: int = 1) -> SteadyMatrices:
        """Return the steady matrices from sample `first` on; L is the mean over `count` samples."""
        ...

    def quasi_steady_parts(self, first: int, count: int) -> list[tuple[int, int]]:
        """Return first sample and count of parts over each of which the matrices hardly change."""
        ...

    def forward_pass(self, first: int, y: Array, start: Array) -> FilterBlock:
        """Return innovations of y (n, c) and predictions, from the state `start` (N,) at sample `first`."""
        ...

    def filtered_outputs(self, filter_block: FilterBlock) -> Outputs:
        """Return the outputs at each sample, given y up to that sample."""
        ...

    def backward_pass(self, filter_block: FilterBlock, adjoint_after: Array) -> tuple[Outputs, Array]:
        """Return the smoothed outputs, and rho (N,) at the first sample, from rho after the last."""
        ...

    def fixed_lag_pass(self, filter_block: FilterBlock, count: int, lag: int) -> Outputs:
        """Return the outputs at the first `count` samples, each given `lag` innovations more where there are any."""
        ...

    def variance(self, first: int, count: int, smoothed: bool) -> Array:
        """Return the steady variance (count, m) of the loads, filtered or smoothed."""
        ...

    def marked_outputs(self, first: int, count: int) -> MarkedOutputs | None:
        """Return the samples that have further outputs, and these; None for a filter without any."""
        ...

    def whiten_innovations(self, filter_block: FilterBlock) -> Array:
        """Return the innovations (n, c) in units in which their covariance is one."""
        ...
