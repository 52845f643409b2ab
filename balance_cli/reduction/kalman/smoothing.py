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

from balance_cli.reduction.kalman import segments as stretching
from balance_cli.reduction.kalman.edge_variance import beside_the_steady, between_edges, decay, seen_through, told_apart
from balance_cli.reduction.kalman.gaps import GAP_BLOCK, smoothed_gap, through_gap
from balance_cli.reduction.kalman.riccati import symmetric
from balance_cli.reduction.kalman.segments import (
    Beginning,
    Estimates,
    Filters,
    Passed,
    Reader,
    Stretch,
    blocks,
    estimates_of,
    excess_at_end,
    output_rows,
    settled,
    told,
    variance_of,
)
from balance_cli.reduction.kalman.steady_filter import Engine, Outputs, Piece, SteadyFilter

Array = NDArray[np.float64]

FORGOTTEN = 1e-8
"""Share of the variance of the outputs that what lies beyond the memory would take away."""
LONGEST_MEMORY = 2**17


def smoothed(read: Reader, stretches: Sequence[Stretch], filters: Filters, beginning: int) -> Iterator[Estimates]:
    """Loads given the whole record.

    The state at the beginning of a stretch is told by all of it, at first by the memory of the filter and no less than
    `beginning` samples where the filter does not change with time, by `beginning` samples where it does; then that is
    made good in the first block, so many samples.
    """
    ahead = max((_memory(filters.engines[s.channels].at(s.start)) for s in stretches if s.channels), default=1)
    waiting: deque[Passed] = deque()
    for passed in _forward(read, stretches, filters, ahead, beginning):
        waiting.append(passed)
        while _length(waiting) - len(waiting[0].piece.predicted) >= max(ahead, stretching.BLOCK):
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
        early = max(ahead, beginning) if engine.invariant else beginning
        start = settled(read, stretch, engine, x, known, early, steps=1)
        begun: Beginning | None = Beginning(known, start - x)
        end_excess = None
        if stretch is not stretches[-1]:
            left = told_apart(known, told(engine, stretch, stretch.stop - stretch.start))
            end_excess = excess_at_end(engine, left, stretch)
            P = engine.at(stretch.stop - 1).P + end_excess
        x = start
        for first, stop in blocks(stretch, head=beginning):
            piece = engine.forward(first, read(first, stop, stretch.channels), x)
            yield Passed(stretch, piece, begun, end_excess if stop == stretch.stop else None)
            x, begun = piece.end, None


@dataclass(frozen=True)
class _Later:
    """What follows a sample: rho (N,), the information J (N, N), and within a stretch what that lacks of O, `missing`.

    O is that of the speed at hand; what is missing of it stays nothing where all that tells anything follows.
    """

    rho: Array
    J: Array
    missing: Array | None = None

    def lacks(self, steady: SteadyFilter) -> Array:
        """O - J (N, N)."""
        return steady.all_information - self.J if self.missing is None else self.missing


def _first_smoothed(waiting: deque[Passed], filters: Filters) -> Estimates:
    """The first block that waits, smoothed by all of them, and forgotten."""
    later, estimates = _nothing(filters), None
    for passed in reversed(waiting):
        estimates, later = _smoothed_block(passed, filters, later)
    waiting.popleft()
    assert estimates is not None
    return estimates


def _all_smoothed(waiting: deque[Passed], filters: Filters) -> Iterator[Estimates]:
    later, found = _nothing(filters), []
    for passed in reversed(waiting):
        estimates, later = _smoothed_block(passed, filters, later)
        found.append(estimates)
    yield from reversed(found)


def _nothing(filters: Filters) -> _Later:
    return _Later(np.zeros(len(filters.prior)), np.zeros_like(filters.prior))


def _smoothed_block(passed: Passed, filters: Filters, later: _Later) -> tuple[Estimates, _Later]:
    """One block, with what follows it; and what follows its start."""
    if passed.covariance is not None:
        estimates, rho, J = smoothed_gap(passed, filters, later.rho, later.J)
        return estimates, _Later(rho, J)
    engine, piece = filters.engines[passed.stretch.channels], passed.piece
    count = len(piece.predicted)
    steady, at = engine.at(piece.first, count), np.arange(count)
    if passed.end_excess is not None:
        later = _Later(*beside_the_steady(passed.end_excess, later.rho, later.J))
    rows, marks = output_rows(engine, piece)
    missing, power = later.lacks(steady), np.linalg.matrix_power(steady.L, count)
    missing_at_start = symmetric(power.T @ missing @ power)
    told_at_start = steady.all_information - missing_at_start
    if passed.beginning is None:
        outputs, rho = engine.backward(piece, later.rho)
        floor = variance_of(rows, steady.P) - variance_of(rows @ steady.P, steady.all_information)
        added = [(decay(rows @ steady.P @ steady.L.T, steady.L.T, missing, count, floor), at[::-1])]
        estimates = estimates_of(engine, piece, outputs, marks, True, passed.stretch, added)
        return estimates, _Later(rho, told_at_start, missing_at_start)
    excess = passed.beginning.excess
    piece, outputs, rho = _begun_again(engine, piece, passed.beginning, later, told_at_start)
    added = [(between_edges(rows, steady, missing, told_apart(excess, told_at_start), count), at)]
    estimates = estimates_of(engine, piece, outputs, marks, True, passed.stretch, added)
    return estimates, _Later(rho, symmetric(seen_through(excess, told_at_start)))


def _begun_again(
    engine: Engine, piece: Piece, beginning: Beginning, later: _Later, told_at_start: Array
) -> tuple[Piece, Outputs, Array]:
    """The first block of a stretch, as all that follows has its first state: what lies behind that stretch, too.

    The first state was moved by d = D rho[0] for the samples of the stretch alone. With those behind it d is off by
    (1 + D O)^-1 (D rho[0] - d), and that runs through the block as a state does where nothing is read.
    """
    _, at_start = engine.backward(piece, later.rho)
    D = beginning.excess
    off = np.linalg.solve(np.eye(len(D)) + D @ told_at_start, D @ at_start - beginning.moved)
    change = engine.forward(piece.first, np.zeros_like(piece.innovation), np.asarray(off, float))
    piece = piece.plus(change)
    return piece, *engine.backward(piece, later.rho - later.J @ change.end)
