"""Gaps of a record, through which the model alone predicts the state."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from balance_cli.reduction.kalman.channel_filter import FilterBlock
from balance_cli.reduction.kalman.riccati import inverse_sum, symmetrize
from balance_cli.reduction.kalman.segments import Estimates, RunFilters, Segment, SegmentBlock, output_variance

Array = NDArray[np.float64]

GAP_BLOCK = 128
"""Samples of a gap whose covariances are held at once: with 100 states 10 MB."""


def predict_through_gap(segment: Segment, filters: RunFilters, x: Array, P: Array) -> tuple[SegmentBlock, Array]:
    """Predict the state through a block of a gap; return the block and the covariance (N, N) after it."""
    states = [x]
    for k in range(segment.start, segment.stop):
        states.append(filters.predictor.step(k, states[-1]))
    predicted = np.array(states[:-1]) @ filters.outputs.T
    filter_block = FilterBlock(segment.start, np.zeros((len(predicted), 0)), predicted, states[-1])
    segment_block = SegmentBlock(segment, filter_block, covariance=P)
    *_, last = gap_covariances(segment_block, filters, beyond=True)
    return segment_block, last


def gap_estimates(segment_block: SegmentBlock, filters: RunFilters) -> Estimates:
    """Return the loads in a block of a gap, given the samples before it."""
    variance = np.array([output_variance(filters.outputs, P) for P in gap_covariances(segment_block, filters)])
    filter_block = segment_block.filter_block
    return Estimates(filter_block.first, filter_block.predicted, variance, None, filter_block.innovation, ())


def gap_covariances(segment_block: SegmentBlock, filters: RunFilters, beyond: bool = False) -> Iterator[Array]:
    """Yield the covariance (N, N) at every sample of a gap, with `beyond` also at the sample after it."""
    P = segment_block.covariance
    assert P is not None
    for k in range(segment_block.segment.start, segment_block.segment.stop):
        yield P
        FP = filters.predictor.step(k, P)
        P = symmetrize(filters.predictor.step(k, FP.T) + filters.noise)
    if beyond:
        yield P


def smooth_gap(
    segment_block: SegmentBlock, filters: RunFilters, rho: Array, J: Array, later: Array | None
) -> tuple[Estimates, Array, Array, Array | None]:
    """Smooth a block of a gap; return its loads, and rho and the information J at its start, from those after it.

    `later` (N, N) is the information of the samples after it, whatever the prior, where it is known; returned last at
    the start. The variance of the loads then is a sum of squares, which rounding does not spoil.
    """
    outputs, variance = segment_block.filter_block.predicted.copy(), np.empty_like(segment_block.filter_block.predicted)
    first, U = segment_block.segment.start, filters.outputs
    for i, P in reversed(list(enumerate(gap_covariances(segment_block, filters)))):
        rho = filters.predictor.back(first + i, rho)
        J = symmetrize(filters.predictor.back(first + i, filters.predictor.back(first + i, J).T))
        spread = U @ P
        outputs[i] += spread @ rho
        if later is None:
            variance[i] = np.maximum(np.sum(spread * U, axis=1) - output_variance(spread, J), 0.0)
        else:
            through = inverse_sum(later, filters.noise)
            back = filters.predictor.back(first + i, through)
            later = back @ back.T
            variance[i] = np.sum((U @ inverse_sum(P, later)) ** 2, axis=1)
    return Estimates(first, outputs, variance, None, segment_block.filter_block.innovation, ()), rho, J, later
