"""A record in stretches: what filters and smoothers share of beginnings, gaps and changes of channels.

A record is cut into stretches in which the same channels are read. Within a stretch the steady filter of these channels
runs; where one begins, what is known of the state differs from what that filter takes for granted, and the difference
is carried along (`edges`). Where nothing is read the state is led on by the model alone (`gaps`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from balance_cli.reduction.kalman.edge_variance import Decay
from balance_cli.reduction.kalman.riccati import discrete_gramian, symmetrize
from balance_cli.reduction.kalman.steady_filter import ChannelFilter, FilterBlock, MarkedOutputs, Outputs

Array = NDArray[np.float64]
Reader = Callable[[int, int, tuple[int, ...]], Array]
"""Samples start to stop of the channels with these numbers, in units of their noise and whitened."""

BLOCK = 32768
"""Samples that go through a filter at a time."""
NEWTON_STEPS = 2
NEGLIGIBLE_INITIAL_ERROR = 1e-8
"""Share of an error at the start of a stretch below which it is of no account any more."""


@dataclass(frozen=True)
class Segment:
    """Samples start to stop in which the channels with these numbers are read (none: a gap)."""

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
    """Loads (n, m) from sample `first` on and their variance (n, m), further outputs at some samples, and the

    innovations (n, c) of the channels that were read, in units in which their covariance is one; none in a gap.
    """

    first: int
    loads: Array
    variance: Array
    marked: MarkedEstimates | None
    innovations: Array
    channels: tuple[int, ...]


class Predictor(Protocol):
    """Leads the state on where nothing is read."""

    def step(self, k: int, x: Array) -> Array:
        """States (N, ...) from sample k to k + 1."""
        ...

    def back(self, k: int, rho: Array) -> Array:
        """Adjoints (N,) from sample k + 1 to k."""
        ...


@dataclass(frozen=True)
class RunFilters:
    """Engines by the channels read, what happens in gaps, and what is known before the first sample.

    `noise` Q and `prior` (N, N), `outputs` U (o, N).
    """

    channel_filters: Mapping[tuple[int, ...], ChannelFilter]
    predictor: Predictor
    noise: Array
    prior: Array
    outputs: Array


@dataclass(frozen=True)
class InitialCorrection:
    """Of a stretch: what the covariance of its first state has above P, `excess` (N, N), and by how much that state was

    moved (N,) for what the samples after it tell.
    """

    excess_covariance: Array
    moved: Array


@dataclass
class SegmentBlock:
    """A block after the forward pass.

    `beginning`, where it begins a stretch; `final_excess_covariance`, where it ends one: what the covariance after it
    has above P;
    `covariance`: that at the start of a block of a gap.
    """

    segment: Segment
    filter_block: FilterBlock
    beginning: InitialCorrection | None = None
    final_excess_covariance: Array | None = None
    covariance: Array | None = None


def blocks(segment: Segment, block: int | None = None, head: int = 0) -> Iterator[tuple[int, int]]:
    """First sample and end of each block of a stretch, the first one no longer than `head` where that is said."""
    block = block or BLOCK
    edges = range(segment.start + (min(head, block) or block), segment.stop, block)
    return pairwise([segment.start, *edges, segment.stop])


def output_rows(channel_filter: ChannelFilter, filter_block: FilterBlock) -> tuple[Array, MarkedOutputs | None]:
    """Outputs (m + q, N) of a block: its loads, and what is given out at marked samples."""
    marked_outputs = channel_filter.marked_outputs(filter_block.first, len(filter_block.predicted))
    U = channel_filter.at(filter_block.first).outputs
    return (U if marked_outputs is None else np.vstack([U, marked_outputs.rows])), marked_outputs


def output_variance(rows: Array, covariance: Array) -> Array:
    """diag(rows covariance rows')."""
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
    """With the steady variance and what edges add to it, each at its numbers (n,) of samples from the edge."""
    m = filter_block.predicted.shape[1]
    variance = channel_filter.variance(filter_block.first, len(filter_block.predicted), smooth)
    for one, at in added:
        variance = variance + one.after(at)[:, :m]
    marked = None
    if marked_outputs is not None and outputs.marked is not None:
        spread = np.tile(
            marked_outputs.smoothed if smooth else marked_outputs.updated, (len(marked_outputs.samples), 1)
        )
        for one, at in added:
            spread = spread + one.after(at[marked_outputs.samples])[:, m:]
        marked = MarkedEstimates(filter_block.first + marked_outputs.samples, outputs.marked, np.maximum(spread, 0.0))
    innovations = channel_filter.whiten_innovations(filter_block)
    return Estimates(
        filter_block.first, outputs.loads, np.maximum(variance, 0.0), marked, innovations, segment.channels
    )


def propagate_excess(channel_filter: ChannelFilter, excess_covariance: Array, segment: Segment) -> Array:
    """What the covariance after a stretch has above P: L^n D L^n'."""
    power: Array = np.eye(len(excess_covariance))
    for first, count in channel_filter.quasi_steady_parts(segment.start, segment.stop - segment.start):
        power = np.linalg.matrix_power(channel_filter.at(first, count).L, count) @ power
        if np.abs(power).max() < NEGLIGIBLE_INITIAL_ERROR:
            break
    return symmetrize(power @ excess_covariance @ power.T)


def segment_information(channel_filter: ChannelFilter, segment: Segment, samples: int) -> Array:
    """What so many samples of a stretch tell of the state at its start (N, N)."""
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
    """The state at the start of a stretch, given what the samples after it tell: x + d with d = D rho[0].

    One Newton step is exact where the engine does not change with time; where it does, O is summed over parts of an
    even speed, and a few `steps` do.
    """
    count = min(ahead, segment.stop - segment.start)
    y = read(segment.start, segment.start + count, segment.channels)
    slope = np.eye(len(x)) + excess_covariance @ segment_information(channel_filter, segment, count)
    found = np.zeros_like(x)
    for _ in range(1 if channel_filter.time_invariant else steps):
        filter_block = channel_filter.forward_pass(segment.start, y, x + found)
        rho = channel_filter.backward_pass(filter_block, np.zeros_like(x))[1]
        found = found + np.linalg.solve(slope, excess_covariance @ rho - found)
    return np.asarray(x + found)
