"""Smoother: loads given the whole record, block by block.

It looks ahead by the memory of the filter, beyond which nothing tells any more: what is held at a time is bounded by
the block and that, however long the record.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.reduction.kalman import segments as segments_module
from balance_cli.reduction.kalman.edge_variance import (
    information_with_excess,
    posterior_excess,
    refer_adjoint_to_steady,
    smoother_edge_variance,
    variance_decay,
)
from balance_cli.reduction.kalman.gaps import GAP_BLOCK, predict_through_gap, smooth_gap
from balance_cli.reduction.kalman.riccati import symmetrize
from balance_cli.reduction.kalman.segments import (
    Estimates,
    InitialCorrection,
    Reader,
    RunFilters,
    Segment,
    SegmentBlock,
    assemble_estimates,
    blocks,
    estimate_initial_state,
    output_rows,
    output_variance,
    propagate_excess,
    segment_information,
)
from balance_cli.reduction.kalman.steady_filter import ChannelFilter, FilterBlock, Outputs, SteadyFilter

Array = NDArray[np.float64]

NEGLIGIBLE_INFORMATION = 1e-8
"""Share of the variance of the outputs that what lies beyond the memory would take away."""
LONGEST_MEMORY = 2**17


def smoothed_estimates(
    read: Reader, segments: Sequence[Segment], filters: RunFilters, beginning: int
) -> Iterator[Estimates]:
    """Loads given the whole record.

    The state at the beginning of a stretch is told by all of it, at first by the memory of the filter and no less than
    `beginning` samples where the filter does not change with time, by `beginning` samples where it does; then that is
    made good in the first block, so many samples.
    """
    ahead = max(
        (_memory_samples(filters.channel_filters[s.channels].at(s.start)) for s in segments if s.channels), default=1
    )
    pending: deque[SegmentBlock] = deque()
    for segment_block in _run_forward_pass(read, segments, filters, ahead, beginning):
        pending.append(segment_block)
        while _sample_count(pending) - len(pending[0].filter_block.predicted) >= max(ahead, segments_module.BLOCK):
            yield _smooth_first(pending, filters)
    yield from _smooth_all(pending, filters)


def _sample_count(pending: Iterable[SegmentBlock]) -> int:
    return sum(len(one.filter_block.predicted) for one in pending)


def _memory_samples(steady: SteadyFilter) -> int:
    """Samples beyond which nothing tells of an output any more."""
    rows = steady.outputs @ steady.P
    base = np.diag(rows @ steady.outputs.T)
    power, count = steady.L, 1
    while count < LONGEST_MEMORY:
        there = rows @ power.T
        if np.all(output_variance(there, steady.all_information) <= NEGLIGIBLE_INFORMATION * base):
            break
        power, count = power @ power, 2 * count
    return count


def _run_forward_pass(
    read: Reader, segments: Sequence[Segment], filters: RunFilters, ahead: int, beginning: int
) -> Iterator[SegmentBlock]:
    x, P = np.zeros(len(filters.prior)), filters.prior
    for segment in segments:
        if not segment.channels:
            for first, stop in blocks(segment, GAP_BLOCK):
                segment_block, P = predict_through_gap(Segment(first, stop, ()), filters, x, P)
                yield segment_block
                x = segment_block.filter_block.end
            continue
        channel_filter = filters.channel_filters[segment.channels]
        known = symmetrize(P - channel_filter.at(segment.start).P)
        # The memory of the loads says nothing of offsets, which take the steady gain far longer to find.
        early = max(ahead, beginning) if channel_filter.time_invariant else beginning
        start = estimate_initial_state(read, segment, channel_filter, x, known, early, steps=1)
        begun: InitialCorrection | None = InitialCorrection(known, start - x)
        final_excess_covariance = None
        if segment is not segments[-1]:
            left = posterior_excess(known, segment_information(channel_filter, segment, segment.stop - segment.start))
            final_excess_covariance = propagate_excess(channel_filter, left, segment)
            P = channel_filter.at(segment.stop - 1).P + final_excess_covariance
        x = start
        for first, stop in blocks(segment, head=beginning):
            filter_block = channel_filter.forward_pass(first, read(first, stop, segment.channels), x)
            yield SegmentBlock(segment, filter_block, begun, final_excess_covariance if stop == segment.stop else None)
            x, begun = filter_block.end, None


@dataclass(frozen=True)
class _BackwardState:
    """What follows a sample: rho (N,), the information J (N, N), and within a stretch what that lacks of O, `missing`.

    O is that of the speed at hand; what is missing of it stays nothing where all that tells anything follows.
    """

    rho: Array
    J: Array
    missing: Array | None = None

    def missing_information(self, steady: SteadyFilter) -> Array:
        """O - J (N, N)."""
        return steady.all_information - self.J if self.missing is None else self.missing


def _smooth_first(pending: deque[SegmentBlock], filters: RunFilters) -> Estimates:
    """The first block that waits, smoothed by all of them, and forgotten."""
    backward_state, estimates = _end_of_record_state(filters), None
    for segment_block in reversed(pending):
        estimates, backward_state = _smooth_block(segment_block, filters, backward_state)
    pending.popleft()
    assert estimates is not None
    return estimates


def _smooth_all(pending: deque[SegmentBlock], filters: RunFilters) -> Iterator[Estimates]:
    backward_state, found = _end_of_record_state(filters), []
    for segment_block in reversed(pending):
        estimates, backward_state = _smooth_block(segment_block, filters, backward_state)
        found.append(estimates)
    yield from reversed(found)


def _end_of_record_state(filters: RunFilters) -> _BackwardState:
    return _BackwardState(np.zeros(len(filters.prior)), np.zeros_like(filters.prior))


def _smooth_block(
    segment_block: SegmentBlock, filters: RunFilters, backward_state: _BackwardState
) -> tuple[Estimates, _BackwardState]:
    """One block, with what follows it; and what follows its start."""
    if segment_block.covariance is not None:
        estimates, rho, J = smooth_gap(segment_block, filters, backward_state.rho, backward_state.J)
        return estimates, _BackwardState(rho, J)
    channel_filter, filter_block = filters.channel_filters[segment_block.segment.channels], segment_block.filter_block
    count = len(filter_block.predicted)
    steady, at = channel_filter.at(filter_block.first, count), np.arange(count)
    if segment_block.final_excess_covariance is not None:
        backward_state = _BackwardState(
            *refer_adjoint_to_steady(segment_block.final_excess_covariance, backward_state.rho, backward_state.J)
        )
    rows, marked_outputs = output_rows(channel_filter, filter_block)
    missing, power = backward_state.missing_information(steady), np.linalg.matrix_power(steady.L, count)
    missing_at_start = symmetrize(power.T @ missing @ power)
    information_at_start = steady.all_information - missing_at_start
    if segment_block.beginning is None:
        outputs, rho = channel_filter.backward_pass(filter_block, backward_state.rho)
        floor = output_variance(rows, steady.P) - output_variance(rows @ steady.P, steady.all_information)
        added = [(variance_decay(rows @ steady.P @ steady.L.T, steady.L.T, missing, count, floor), at[::-1])]
        estimates = assemble_estimates(
            channel_filter, filter_block, outputs, marked_outputs, True, segment_block.segment, added
        )
        return estimates, _BackwardState(rho, information_at_start, missing_at_start)
    excess_covariance = segment_block.beginning.excess_covariance
    filter_block, outputs, rho = _correct_initial_state(
        channel_filter, filter_block, segment_block.beginning, backward_state, information_at_start
    )
    added = [
        (
            smoother_edge_variance(
                rows, steady, missing, posterior_excess(excess_covariance, information_at_start), count
            ),
            at,
        )
    ]
    estimates = assemble_estimates(
        channel_filter, filter_block, outputs, marked_outputs, True, segment_block.segment, added
    )
    return estimates, _BackwardState(rho, symmetrize(information_with_excess(excess_covariance, information_at_start)))


def _correct_initial_state(
    channel_filter: ChannelFilter,
    filter_block: FilterBlock,
    beginning: InitialCorrection,
    backward_state: _BackwardState,
    information_at_start: Array,
) -> tuple[FilterBlock, Outputs, Array]:
    """The first block of a stretch, as all that follows has its first state: what lies behind that stretch, too.

    The first state was moved by d = D rho[0] for the samples of the stretch alone. With those behind it d is off by
    (1 + D O)^-1 (D rho[0] - d), and that runs through the block as a state does where nothing is read.
    """
    _, at_start = channel_filter.backward_pass(filter_block, backward_state.rho)
    D = beginning.excess_covariance
    off = np.linalg.solve(np.eye(len(D)) + D @ information_at_start, D @ at_start - beginning.moved)
    change = channel_filter.forward_pass(
        filter_block.first, np.zeros_like(filter_block.innovation), np.asarray(off, float)
    )
    filter_block = filter_block.superpose(change)
    return filter_block, *channel_filter.backward_pass(filter_block, backward_state.rho - backward_state.J @ change.end)
