"""Smoother: loads given the whole record, block by block.

It looks ahead by the memory of the filter, beyond which nothing tells any more: what is held at a time is bounded by
the block and that, however long the record.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.kalman.edges import between_edges, decay, seen_through, told_apart
from balance_cli.kalman.gaps import GAP_BLOCK, smoothed_gap, through_gap
from balance_cli.kalman.riccati import symmetric
from balance_cli.kalman.steady import SteadyFilter
from balance_cli.kalman.stretches import (
    Estimates,
    Filters,
    Passed,
    Reader,
    Stretch,
    blocks,
    covariance_at_end,
    estimates_of,
    output_rows,
    settled,
    told,
    variance_of,
)

Array = NDArray[np.float64]

FORGOTTEN = 1e-8
"""Share of the variance of the outputs that what lies beyond the memory would take away."""
LONGEST_MEMORY = 2**17


def smoothed(read: Reader, stretches: Sequence[Stretch], filters: Filters, beginning: int) -> Iterator[Estimates]:
    """Loads given the whole record.

    The state at the beginning of a stretch is told by the memory of the filter and no less than `beginning` samples
    where the filter does not change with time, by `beginning` samples where it does.
    """
    ahead = max((_memory(filters.engines[s.channels].at(s.start)) for s in stretches if s.channels), default=1)
    waiting: deque[Passed] = deque()
    for passed in _forward(read, stretches, filters, ahead, beginning):
        waiting.append(passed)
        while _length(waiting) - len(waiting[0].piece.predicted) >= ahead:
            yield _first_smoothed(waiting, filters)
    yield from _all_smoothed(waiting, filters)


def _length(waiting: Iterable[Passed]) -> int:
    return sum(len(one.piece.predicted) for one in waiting)


def _memory(steady: SteadyFilter) -> int:
    """Samples beyond which nothing tells of an output any more."""
    rows = steady.outputs @ steady.P
    base = np.diag(rows @ steady.outputs.T)
    power, count = steady.L, 1
    while count < LONGEST_MEMORY:
        there = rows @ power.T
        if np.all(variance_of(there, steady.all_information) <= FORGOTTEN * base):
            break
        power, count = power @ power, 2 * count
    return count


def _forward(
    read: Reader, stretches: Sequence[Stretch], filters: Filters, ahead: int, beginning: int
) -> Iterator[Passed]:
    x, P = np.zeros(len(filters.prior)), filters.prior
    for stretch in stretches:
        if not stretch.channels:
            for first, stop in blocks(stretch, GAP_BLOCK):
                passed, P = through_gap(Stretch(first, stop, ()), filters, x, P)
                yield passed
                x = passed.piece.end
            continue
        engine = filters.engines[stretch.channels]
        known = symmetric(P - engine.at(stretch.start).P)
        # The memory of the loads says nothing of offsets, which take the steady gain far longer to find.
        x = settled(read, stretch, engine, x, known, max(ahead, beginning) if engine.invariant else beginning)
        excess: Array | None = known
        for first, stop in blocks(stretch):
            piece = engine.forward(first, read(first, stop, stretch.channels), x)
            yield Passed(stretch, piece, excess)
            x, excess = piece.end, None
        if stretch is not stretches[-1]:
            start = told_apart(known, told(engine, stretch, stretch.stop - stretch.start))
            P = covariance_at_end(engine, start, stretch)


def _first_smoothed(waiting: deque[Passed], filters: Filters) -> Estimates:
    """The first block that waits, smoothed by all of them, and forgotten."""
    rho, J = np.zeros(len(filters.prior)), np.zeros_like(filters.prior)
    estimates = None
    for passed in reversed(waiting):
        estimates, rho, J = _smoothed_block(passed, filters, rho, J)
    waiting.popleft()
    assert estimates is not None
    return estimates


def _all_smoothed(waiting: deque[Passed], filters: Filters) -> Iterator[Estimates]:
    rho, J = np.zeros(len(filters.prior)), np.zeros_like(filters.prior)
    found = []
    for passed in reversed(waiting):
        estimates, rho, J = _smoothed_block(passed, filters, rho, J)
        found.append(estimates)
    yield from reversed(found)


def _smoothed_block(passed: Passed, filters: Filters, rho: Array, J: Array) -> tuple[Estimates, Array, Array]:
    """One block, with rho and the information J (N, N) at its end; both at its start."""
    if passed.covariance is not None:
        return smoothed_gap(passed, filters, rho, J)
    piece, count = passed.piece, len(passed.piece.predicted)
    engine = filters.engines[passed.stretch.channels]
    steady = engine.at(piece.first, count)
    total, P, L = steady.all_information, steady.P, steady.L
    outputs, rho = engine.backward(piece, rho)
    rows, marks = output_rows(engine, piece)
    floor = variance_of(rows, P) - variance_of(rows @ P, total)
    at = np.arange(count)
    missing, power = total - J, np.linalg.matrix_power(L, count)
    J = symmetric(total - power.T @ missing @ power)
    if passed.excess is None:
        added = [(decay(rows @ P @ L.T, L.T, missing, count, floor), at[::-1])]
    else:
        start = told_apart(passed.excess, J)
        J = symmetric(seen_through(passed.excess, J))
        added = [(between_edges(rows, steady, missing, start, count), at)]
    return estimates_of(engine, piece, outputs, marks, True, passed.stretch, added), rho, J
