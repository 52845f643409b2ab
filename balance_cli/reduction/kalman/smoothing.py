"""Smoother: loads given the whole record, block by block.

Each block is smoothed with the samples that follow within the memory of the filter; later samples carry no further
information. The memory that this needs is bounded by the block and by that span, however long the record.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.reduction.kalman import segments as segments_module
from balance_cli.reduction.kalman.channel_filter import ChannelFilter, FilterBlock, Outputs
from balance_cli.reduction.kalman.edge_variance import (
    information_with_excess,
    posterior_excess,
    refer_adjoint_to_steady,
    refine_near_start,
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
from balance_cli.reduction.kalman.steady_matrices import SteadyMatrices

Array = NDArray[np.float64]

NEGLIGIBLE_INFORMATION = 1e-8
"""Share of the variance of the outputs by which samples beyond the memory would reduce it: far below any sigma."""
LONGEST_MEMORY = 2**17
"""Samples at which the search for the memory ends: two minutes at 1 kHz."""


def smoothed_estimates(
    read: Reader, segments: Sequence[Segment], filters: RunFilters, beginning: int
) -> Iterator[Estimates]:
    """Yield the loads given the whole record.

    The initial state of a segment is first estimated from the samples within the memory of the filter, `beginning`
    samples at least, or from `beginning` samples where the filter varies with time. The first block of the segment, of
    `beginning` samples, then corrects it with all samples that follow.
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
    return sum(len(item.filter_block.predicted) for item in pending)


def _memory_samples(steady: SteadyMatrices) -> int:
    """Return the number of samples beyond which none carries information about an output."""
    rows = steady.outputs @ steady.P
    variance = np.diag(rows @ steady.outputs.T)
    power, count = steady.L, 1
    while count < LONGEST_MEMORY:
        if np.all(output_variance(rows @ power.T, steady.all_information) <= NEGLIGIBLE_INFORMATION * variance):
            break
        power, count = power @ power, 2 * count
    return count


def _run_forward_pass(
    read: Reader, segments: Sequence[Segment], filters: RunFilters, ahead: int, beginning: int
) -> Iterator[SegmentBlock]:
    """Yield all blocks of all segments after the forward pass."""
    x, P = np.zeros(len(filters.prior)), filters.prior
    for segment in segments:
        if not segment.channels:
            for first, stop in blocks(segment, GAP_BLOCK):
                segment_block, P = predict_through_gap(Segment(first, stop, ()), filters, x, P)
                yield segment_block
                x = segment_block.filter_block.end
            continue
        channel_filter = filters.channel_filters[segment.channels]
        excess = symmetrize(P - channel_filter.at(segment.start).P)
        # Offsets need more samples than the memory of the loads: at the steady gain they converge slowly.
        samples = max(ahead, beginning) if channel_filter.time_invariant else beginning
        start = estimate_initial_state(read, segment, channel_filter, x, excess, samples, steps=1)
        correction: InitialCorrection | None = InitialCorrection(excess, start - x)
        final_excess = None
        if segment is not segments[-1]:
            final_excess = _final_excess(channel_filter, segment, excess)
            P = channel_filter.at(segment.stop - 1).P + final_excess
        x = start
        for first, stop in blocks(segment, head=beginning):
            filter_block = channel_filter.forward_pass(first, read(first, stop, segment.channels), x)
            yield SegmentBlock(segment, filter_block, correction, final_excess if stop == segment.stop else None)
            x, correction = filter_block.end, None


def _final_excess(channel_filter: ChannelFilter, segment: Segment, excess: Array) -> Array:
    """Return the excess covariance (N, N) after a segment, given all its samples, from that at its start."""
    information = segment_information(channel_filter, segment, segment.stop - segment.start)
    return propagate_excess(channel_filter, posterior_excess(excess, information), segment)


@dataclass(frozen=True)
class _BackwardState:
    """Backward recursion after a sample: rho (N,), information J (N, N) and, within a segment, `missing` = O - J.

    O is that of the current speed. Where enough samples follow, `missing` is zero and stays so while O changes. `later`
    (N, N) is the information of the samples after a gap, whatever the prior there, where it is that of all samples.
    """

    rho: Array
    J: Array
    missing: Array | None = None
    later: Array | None = None

    def missing_information(self, steady: SteadyMatrices) -> Array:
        """Return O - J (N, N)."""
        return steady.all_information - self.J if self.missing is None else self.missing


def _smooth_first(pending: deque[SegmentBlock], filters: RunFilters) -> Estimates:
    """Remove the first pending block and return its estimates, given all pending blocks."""
    backward_state, estimates = _end_of_record_state(filters), None
    for segment_block in reversed(pending):
        estimates, backward_state = _smooth_block(segment_block, filters, backward_state)
    pending.popleft()
    assert estimates is not None
    return estimates


def _smooth_all(pending: deque[SegmentBlock], filters: RunFilters) -> Iterator[Estimates]:
    backward_state, smoothed = _end_of_record_state(filters), []
    for segment_block in reversed(pending):
        estimates, backward_state = _smooth_block(segment_block, filters, backward_state)
        smoothed.append(estimates)
    yield from reversed(smoothed)


def _end_of_record_state(filters: RunFilters) -> _BackwardState:
    return _BackwardState(np.zeros(len(filters.prior)), np.zeros_like(filters.prior))


def _smooth_block(
    segment_block: SegmentBlock, filters: RunFilters, backward_state: _BackwardState
) -> tuple[Estimates, _BackwardState]:
    """Smooth one block given the state after it; return its estimates and the state at its start."""
    if segment_block.covariance is not None:
        estimates, rho, J, later = smooth_gap(
            segment_block, filters, backward_state.rho, backward_state.J, backward_state.later
        )
        return estimates, _BackwardState(rho, J, later=later)
    if segment_block.final_excess_covariance is not None:
        backward_state = _BackwardState(
            *refer_adjoint_to_steady(segment_block.final_excess_covariance, backward_state.rho, backward_state.J)
        )
    channel_filter = filters.channel_filters[segment_block.segment.channels]
    if segment_block.beginning is None:
        return _smooth_inner_block(segment_block, channel_filter, backward_state)
    return _smooth_first_block(segment_block, segment_block.beginning, channel_filter, backward_state)


def _smooth_inner_block(
    segment_block: SegmentBlock, channel_filter: ChannelFilter, backward_state: _BackwardState
) -> tuple[Estimates, _BackwardState]:
    """Smooth a block that does not begin a segment."""
    filter_block = segment_block.filter_block
    count = len(filter_block.predicted)
    steady = channel_filter.at(filter_block.first, count)
    missing = backward_state.missing_information(steady)
    missing_at_start = _missing_at_start(steady, missing, count)
    rows, marked_outputs = output_rows(channel_filter, filter_block)
    outputs, rho = channel_filter.backward_pass(filter_block, backward_state.rho)
    floor = output_variance(rows, steady.P) - output_variance(rows @ steady.P, steady.all_information)
    end_effect = variance_decay(rows @ steady.P @ steady.L.T, steady.L.T, missing, count, floor)
    added = [(end_effect, np.arange(count)[::-1])]
    estimates = assemble_estimates(
        channel_filter, filter_block, outputs, marked_outputs, True, segment_block.segment, added
    )
    return estimates, _BackwardState(rho, steady.all_information - missing_at_start, missing_at_start)


def _smooth_first_block(
    segment_block: SegmentBlock,
    beginning: InitialCorrection,
    channel_filter: ChannelFilter,
    backward_state: _BackwardState,
) -> tuple[Estimates, _BackwardState]:
    """Smooth the first block of a segment, whose initial state the samples after it correct."""
    count = len(segment_block.filter_block.predicted)
    steady = channel_filter.at(segment_block.filter_block.first, count)
    missing = backward_state.missing_information(steady)
    information_at_start = steady.all_information - _missing_at_start(steady, missing, count)
    excess_covariance = beginning.excess_covariance
    rows, marked_outputs = output_rows(channel_filter, segment_block.filter_block)
    filter_block, outputs, rho = _correct_initial_state(
        channel_filter, segment_block.filter_block, beginning, backward_state, information_at_start
    )
    start = posterior_excess(excess_covariance, information_at_start)
    edges = smoother_edge_variance(rows, steady, missing, start, count)
    later = steady.future_information if channel_filter.time_invariant and _reaches_memory(steady, count) else None
    if later is not None:
        edges = refine_near_start(edges, rows, steady, later, excess_covariance)
    added = [(edges, np.arange(count))]
    estimates = assemble_estimates(
        channel_filter, filter_block, outputs, marked_outputs, True, segment_block.segment, added
    )
    J = symmetrize(information_with_excess(excess_covariance, information_at_start))
    return estimates, _BackwardState(rho, J, later=later)


def _reaches_memory(steady: SteadyMatrices, count: int) -> bool:
    """Whether the first of so many samples is known as from a record without an end."""
    return count >= _memory_samples(steady)


def _missing_at_start(steady: SteadyMatrices, missing: Array, count: int) -> Array:
    """Return the missing information `count` samples earlier, L^n' (O - J) L^n."""
    power = np.linalg.matrix_power(steady.L, count)
    return symmetrize(power.T @ missing @ power)


def _correct_initial_state(
    channel_filter: ChannelFilter,
    filter_block: FilterBlock,
    beginning: InitialCorrection,
    backward_state: _BackwardState,
    information_at_start: Array,
) -> tuple[FilterBlock, Outputs, Array]:
    """Correct the initial state of a segment by all that follows; return its first block, the outputs and rho.

    The initial state was moved by d = D rho[0] for the first samples of the segment. Given all that follow, d lacks
    (1 + D O)^-1 (D rho[0] - d), which propagates through the block like a state whose channels read zero.
    """
    _, rho_at_start = channel_filter.backward_pass(filter_block, backward_state.rho)
    D = beginning.excess_covariance
    correction = np.linalg.solve(np.eye(len(D)) + D @ information_at_start, D @ rho_at_start - beginning.moved)
    change = channel_filter.forward_pass(
        filter_block.first, np.zeros_like(filter_block.innovation), np.asarray(correction, float)
    )
    filter_block = filter_block.superpose(change)
    return filter_block, *channel_filter.backward_pass(filter_block, backward_state.rho - backward_state.J @ change.end)
