"""Filters: loads at each sample given the samples up to it, or up to a fixed lag after it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from balance_cli.reduction.kalman.channel_filter import ChannelFilter, FilterBlock
from balance_cli.reduction.kalman.edge_variance import Decay, posterior_excess, variance_decay
from balance_cli.reduction.kalman.gaps import GAP_BLOCK, gap_estimates, predict_through_gap
from balance_cli.reduction.kalman.riccati import symmetrize
from balance_cli.reduction.kalman.segments import (
    Estimates,
    Reader,
    RunFilters,
    Segment,
    assemble_estimates,
    blocks,
    estimate_initial_state,
    output_rows,
    output_variance,
    propagate_excess,
    segment_information,
)

Array = NDArray[np.float64]


def filtered_estimates(
    read: Reader, segments: Sequence[Segment], filters: RunFilters, beginning: int, lag: int | None = None
) -> Iterator[Estimates]:
    """Yield the loads at each sample given the samples up to it, or up to `lag` after it.

    The initial state of the record is estimated from its first `beginning` samples, because an error of the initial
    state would decay slowly at the steady gain. With a lag that of each segment is, from as many samples as the lag at
    least; a filter that varies with time uses up to twice as many, and no estimate uses samples beyond a gap.
    """
    x, P = np.zeros(len(filters.prior)), filters.prior
    samples = max(beginning, lag or 0)
    for segment in segments:
        if not segment.channels:
            for first, stop in blocks(segment, GAP_BLOCK):
                segment_block, P = predict_through_gap(Segment(first, stop, ()), filters, x, P)
                yield gap_estimates(segment_block, filters)
                x = segment_block.filter_block.end
            continue
        channel_filter = filters.channel_filters[segment.channels]
        excess_covariance = symmetrize(P - channel_filter.at(segment.start).P)
        if lag is not None or segment is segments[0]:
            x = estimate_initial_state(read, segment, channel_filter, x, excess_covariance, samples)
            excess_covariance = posterior_excess(
                excess_covariance, segment_information(channel_filter, segment, samples)
            )
        edges = None if lag is None else _SegmentEdges(channel_filter, segment, excess_covariance, lag)
        for first, stop in blocks(segment):
            filter_block = channel_filter.forward_pass(first, read(first, stop, segment.channels), x)
            x = filter_block.end
            if edges is None:
                yield _filter_block_estimates(channel_filter, filter_block, segment, excess_covariance)
            else:
                yield edges.fixed_lag_block(edges.with_samples_ahead(filter_block, read, stop), stop - first)
        P = channel_filter.at(segment.stop - 1).P + propagate_excess(channel_filter, excess_covariance, segment)


def _filter_block_estimates(
    channel_filter: ChannelFilter, filter_block: FilterBlock, segment: Segment, excess_covariance: Array
) -> Estimates:
    """Return the filtered loads of a block; the segment began with this excess covariance."""
    count = len(filter_block.predicted)
    steady = channel_filter.at(segment.start, count)
    rows, marked_outputs = output_rows(channel_filter, filter_block)
    updated_rows = rows - (rows @ steady.update_gain) @ steady.model.H
    offset, floor = filter_block.first - segment.start, output_variance(rows, steady.P)
    initial_effect = variance_decay(updated_rows, steady.L, excess_covariance, offset + count, floor)
    outputs, added = channel_filter.filtered_outputs(filter_block), [(initial_effect, np.arange(count) + offset)]
    return assemble_estimates(channel_filter, filter_block, outputs, marked_outputs, False, segment, added)


@dataclass(frozen=True)
class _SegmentEdges:
    """A segment with a fixed lag: what its start and its end add to the variance of an output."""

    channel_filter: ChannelFilter
    segment: Segment
    excess_covariance: Array
    lag: int

    def with_samples_ahead(self, filter_block: FilterBlock, read: Reader, stop: int) -> FilterBlock:
        """Append the innovations of the samples after a block that ends at `stop`, up to the lag."""
        if stop == self.segment.stop:
            return filter_block
        following = read(stop, min(stop + self.lag, self.segment.stop), self.segment.channels)
        ahead = self.channel_filter.forward_pass(stop, following, filter_block.end)
        return filter_block.with_innovations(ahead.innovation)

    def fixed_lag_block(self, filter_block: FilterBlock, count: int) -> Estimates:
        """Return the first `count` samples of a block, each given `lag` samples more or as many as there are."""
        outputs = self.channel_filter.fixed_lag_pass(filter_block, count, self.lag)
        block = replace(filter_block, innovation=filter_block.innovation[:count])
        _, marked_outputs = output_rows(self.channel_filter, block)
        at, (ends, starts) = np.arange(count), self._decays
        added = [
            (ends, np.minimum(len(filter_block.innovation) - 1 - at, self.lag)),
            (starts, at + filter_block.first - self.segment.start),
        ]
        return assemble_estimates(self.channel_filter, block, outputs, marked_outputs, True, self.segment, added)

    @cached_property
    def _decays(self) -> tuple[Decay, Decay]:
        """Effects of the samples that are not known yet and of the initial state, at the mean speed of the segment."""
        samples = self.segment.stop - self.segment.start
        steady, marked_outputs = (
            self.channel_filter.at(self.segment.start, samples),
            self.channel_filter.marked_outputs(self.segment.start, 1),
        )
        rows = steady.outputs if marked_outputs is None else np.vstack([steady.outputs, marked_outputs.rows])
        P, L, total = steady.P, steady.L, steady.all_information
        floor = output_variance(rows, P) - output_variance(rows @ P, total)
        return (
            variance_decay(rows @ P @ L.T, L.T, total, self.lag + 1, floor),
            variance_decay(rows - (rows @ P) @ total, L, self.excess_covariance, samples, floor),
        )
