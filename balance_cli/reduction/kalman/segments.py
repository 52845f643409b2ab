"""Segments of a record: what filters and smoothers share of initial states, gaps and changes of channels.

A record is divided into segments in which the same channels are read. Within a segment the steady filter of these
channels runs. At its start the covariance of the state differs from the steady one; `edge_variance` propagates the
difference. Where no channel is read the model alone predicts the state (`gaps`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from balance_cli.reduction.kalman.channel_filter import ChannelFilter, FilterBlock, MarkedOutputs, Outputs
from balance_cli.reduction.kalman.edge_variance import Decay
from balance_cli.reduction.kalman.riccati import discrete_gramian, symmetrize

Array = NDArray[np.float64]
Reader = Callable[[int, int, tuple[int, ...]], Array]
"""Returns samples start to stop of the channels with these numbers, in units of their noise."""

BLOCK = 32768
"""Samples that a filter takes at a time: 26 MB of states for a model of 100."""
NEWTON_STEPS = 2
"""Newton steps for the initial state where the filter varies with time: the sum over quasi-steady parts has the
information within 2 %, so that the second step leaves 4e-4 of the correction."""
NEGLIGIBLE_INITIAL_ERROR = 1e-8
"""Share of an error at the start of a segment below which its propagation ends: far below any sigma."""


@dataclass(frozen=True)
class Segment:
    """Samples start to stop, in which the channels with these numbers are read; a gap has no channels."""

    start: int
    stop: int
    channels: tuple[int, ...]


@dataclass(frozen=True)
class MarkedEstimates:
    """Further outputs (r, q) at the samples (r,) of the record, and their variance (r, q)."""

    samples: NDArray[np.intp]
    outputs: Array
    variance: Array


@dataclass(frozen=True)
class Estimates:
    """Loads (n, m) from sample `first` on with their variance (n, m), and further outputs at some samples.

    `innovations` (n, c) of the channels that were read are in units in which their covariance is one; c = 0 in a gap.
    """

    first: int
    loads: Array
    variance: Array
    marked: MarkedEstimates | None
    innovations: Array
    channels: tuple[int, ...]


class Predictor(Protocol):
    """Predicts the state where no channel is read."""

    def step(self, k: int, x: Array) -> Array:
        """Propagate states (N, ...) from sample k to k + 1."""
        ...

    def back(self, k: int, rho: Array) -> Array:
        """Propagate adjoints (N, ...) from sample k + 1 to k."""
        ...


@dataclass(frozen=True)
class RunFilters:
    """The filters of one run by the channels read, the predictor of gaps, and the prior of the first sample.

    `noise` Q (N, N) of a step, `prior` covariance (N, N), `outputs` U (o, N).
    """

    channel_filters: Mapping[tuple[int, ...], ChannelFilter]
    predictor: Predictor
    noise: Array
    prior: Array
    outputs: Array


@dataclass(frozen=True)
class InitialCorrection:
    """Initial state of a segment: its covariance less P, and the correction (N,) already made by later samples."""

    excess_covariance: Array
    moved: Array


@dataclass
class SegmentBlock:
    """A block of a segment after the forward pass.

    `beginning`: of the first block of a segment; `final_excess_covariance` (N, N), of its last block: the covariance
    after it less P; `covariance` (N, N): at the start of a block of a gap.
    """

    segment: Segment
    filter_block: FilterBlock
    beginning: InitialCorrection | None = None
    final_excess_covariance: Array | None = None
    covariance: Array | None = None


def blocks(segment: Segment, block: int | None = None, head: int = 0) -> Iterator[tuple[int, int]]:
    """Return first sample and end of each block of a segment; `head` limits the length of the first one."""
    block = block or BLOCK
    edges = range(segment.start + (min(head, block) or block), segment.stop, block)
    return pairwise([segment.start, *edges, segment.stop])


def output_rows(channel_filter: ChannelFilter, filter_block: FilterBlock) -> tuple[Array, MarkedOutputs | None]:
    """Return the output rows (m + q, N) of a block: those of the loads, and those of the marked samples."""
    marked_outputs = channel_filter.marked_outputs(filter_block.first, len(filter_block.predicted))
    U = channel_filter.at(filter_block.first).outputs
    return (U if marked_outputs is None else np.vstack([U, marked_outputs.rows])), marked_outputs


def output_variance(rows: Array, covariance: Array) -> Array:
    """Return diag(rows covariance rows') (o,)."""
    return np.asarray(np.einsum("on,on->o", rows @ covariance, rows))


def assemble_estimates(
    channel_filter: ChannelFilter,
    filter_block: FilterBlock,
    outputs: Outputs,
    marked_outputs: MarkedOutputs | None,
    smooth: bool,
    segment: Segment,
    added: Sequence[tuple[Decay, NDArray[np.intp]]],
) -> Estimates:
    """Return the outputs of a block with their variance.

    `added` are variances beyond the steady one from edges of the segment, each with the numbers (n,) of samples from
    its edge.
    """
    m = filter_block.predicted.shape[1]
    variance = channel_filter.variance(filter_block.first, len(filter_block.predicted), smooth)
    for decay, distance in added:
        variance = variance + decay.after(distance)[:, :m]
    marked = None
    if marked_outputs is not None and outputs.marked is not None:
        steady = marked_outputs.smoothed_variance if smooth else marked_outputs.filtered_variance
        total = np.tile(steady, (len(marked_outputs.samples), 1))
        for decay, distance in added:
            total = total + decay.after(distance[marked_outputs.samples])[:, m:]
        marked = MarkedEstimates(filter_block.first + marked_outputs.samples, outputs.marked, np.maximum(total, 0.0))
    innovations = channel_filter.whiten_innovations(filter_block)
    return Estimates(
        filter_block.first, outputs.loads, np.maximum(variance, 0.0), marked, innovations, segment.channels
    )


def propagate_excess(channel_filter: ChannelFilter, excess_covariance: Array, segment: Segment) -> Array:
    """Return the excess covariance after a segment, L^n D L^n', from that at its start."""
    power: Array = np.eye(len(excess_covariance))
    for first, count in channel_filter.quasi_steady_parts(segment.start, segment.stop - segment.start):
        power = np.linalg.matrix_power(channel_filter.at(first, count).L, count) @ power
        if np.abs(power).max() < NEGLIGIBLE_INITIAL_ERROR:
            break
    return symmetrize(power @ excess_covariance @ power.T)


def segment_information(channel_filter: ChannelFilter, segment: Segment, samples: int) -> Array:
    """Return the information (N, N) of the first `samples` of a segment about the state at its start."""
    information = np.zeros_like(channel_filter.at(segment.start).L)
    shift: Array = np.eye(len(information))
    for first, count in channel_filter.quasi_steady_parts(segment.start, min(samples, segment.stop - segment.start)):
        steady = channel_filter.at(first, count)
        information = information + shift.T @ discrete_gramian(steady.L, steady.information, count) @ shift
        shift = np.linalg.matrix_power(steady.L, count) @ shift
        if np.abs(shift).max() < NEGLIGIBLE_INITIAL_ERROR:
            break
    return symmetrize(information)


def estimate_initial_state(
    read: Reader,
    segment: Segment,
    channel_filter: ChannelFilter,
    x: Array,
    excess_covariance: Array,
    ahead: int,
    steps: int = NEWTON_STEPS,
) -> Array:
    """Return the state at the start of a segment given `ahead` samples after it: x + d with d = D rho[0].

    One Newton step is exact where the filter is time-invariant. Where it is not, O is summed over quasi-steady parts,
    and the step is repeated `steps` times.
    """
    count = min(ahead, segment.stop - segment.start)
    y = read(segment.start, segment.start + count, segment.channels)
    jacobian = np.eye(len(x)) + excess_covariance @ segment_information(channel_filter, segment, count)
    correction = np.zeros_like(x)
    for _ in range(1 if channel_filter.time_invariant else steps):
        filter_block = channel_filter.forward_pass(segment.start, y, x + correction)
        rho = channel_filter.backward_pass(filter_block, np.zeros_like(x))[1]
        correction = correction + np.linalg.solve(jacobian, excess_covariance @ rho - correction)
    return np.asarray(x + correction)
