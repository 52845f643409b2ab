"""One record through a filter and a smoother: beginnings, gaps and changes of channels, block by block.

A record is cut into stretches in which the same channels are read. Within a stretch the steady filter of these channels
runs; where one begins, what is known of the state differs from what that filter takes for granted, and the difference
is carried along (`edges`). Where nothing is read the state is led on by the model alone.

The smoother looks ahead by the memory of the filter, beyond which nothing tells any more: what is held at a time is
bounded by the block and that, however long the record.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from balance_cli.kalman.edges import Decay, between_edges, decay, seen_through, told_apart
from balance_cli.kalman.riccati import accumulated, symmetric
from balance_cli.kalman.steady import Engine, Marks, Outputs, Piece, SteadyFilter

Array = NDArray[np.float64]
Reader = Callable[[int, int, tuple[int, ...]], Array]
"""Samples start to stop of the channels with these numbers, in units of their noise and whitened."""

BLOCK = 32768
FORGOTTEN = 1e-8
"""Share of the variance of the outputs that what lies beyond the memory would take away."""
LONGEST_MEMORY = 2**17
CORRECTIONS = 2
SHORT = 1024
"""Samples of a stretch below which its edges are seen from each other."""
GAP_BLOCK = 128
"""Samples of a gap whose covariances are held at once."""


@dataclass(frozen=True)
class Stretch:
    """Samples start to stop in which the channels with these numbers are read (none: a gap)."""

    start: int
    stop: int
    channels: tuple[int, ...]


@dataclass(frozen=True)
class Marked:
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
    marked: Marked | None
    innovations: Array
    channels: tuple[int, ...]


class Coast(Protocol):
    """Leads the state on where nothing is read."""

    def step(self, k: int, x: Array) -> Array:
        """States (N, ...) from sample k to k + 1."""
        ...

    def back(self, k: int, rho: Array) -> Array:
        """Adjoints (N,) from sample k + 1 to k."""
        ...


@dataclass(frozen=True)
class Filters:
    """Engines by the channels read, what happens in gaps, and what is known before the first sample.

    `noise` Q and `prior` (N, N), `outputs` U (o, N).
    """

    engines: Mapping[tuple[int, ...], Engine]
    coast: Coast
    noise: Array
    prior: Array
    outputs: Array


@dataclass
class _Passed:
    """A block after the forward pass.

    `excess`: what the covariance at its start has above P, where it begins a stretch; `covariance`: that at the start
    of a block of a gap.
    """

    stretch: Stretch
    piece: Piece
    excess: Array | None = None
    covariance: Array | None = None


def filtered(read: Reader, stretches: Sequence[Stretch], filters: Filters, beginning: int) -> Iterator[Estimates]:
    """Loads given each sample and those before it.

    The state at the beginning of the record is that which the first `beginning` samples tell: the gain is steady from
    there on, and what a record begins with would take it long to forget.
    """
    x, P = np.zeros(len(filters.prior)), filters.prior
    for stretch in stretches:
        if not stretch.channels:
            for first, stop in _blocks(stretch, GAP_BLOCK):
                passed, P = _through_gap(Stretch(first, stop, ()), filters, x, P)
                yield _led_on(passed, filters)
                x = passed.piece.end
            continue
        engine = filters.engines[stretch.channels]
        excess = symmetric(P - engine.at(stretch.start).P)
        if stretch is stretches[0]:
            x = _settled(read, stretch, engine, x, excess, beginning)
            excess = told_apart(excess, _told(engine, stretch, beginning))
        for first, stop in _blocks(stretch, BLOCK):
            piece = engine.forward(first, read(first, stop, stretch.channels), x)
            x = piece.end
            yield _updated(engine, piece, stretch, excess)
        P = _at_end(engine, excess, stretch)


def _updated(engine: Engine, piece: Piece, stretch: Stretch, excess: Array) -> Estimates:
    """What the filter says of a block of a stretch that began with this excess."""
    steady, count = engine.at(stretch.start), len(piece.predicted)
    rows, marks = _rows(engine, piece)
    after = rows - (rows @ steady.update_gain) @ steady.model.H
    fading = decay(after, steady.L, excess, piece.first - stretch.start + count, _variance(rows, steady.P))
    added = (fading, np.arange(count) + piece.first - stretch.start)
    return _estimates(engine, piece, engine.updated(piece), marks, False, stretch, [added])


def _rows(engine: Engine, piece: Piece) -> tuple[Array, Marks | None]:
    """Outputs (m + q, N) of a block: its loads, and what is given out at marked samples."""
    marks = engine.marks(piece.first, len(piece.predicted))
    U = engine.at(piece.first).outputs
    return (U if marks is None else np.vstack([U, marks.rows])), marks


def lagged(
    read: Reader, stretches: Sequence[Stretch], filters: Filters, beginning: int, lag: int
) -> Iterator[Estimates]:
    """Loads given each sample and `lag` samples after it, those before it too; as `filtered` otherwise.

    Of a filter that changes with time each knows up to twice as many. Nobody looks across a gap.
    """
    x, P = np.zeros(len(filters.prior)), filters.prior
    for stretch in stretches:
        if not stretch.channels:
            for first, stop in _blocks(stretch, GAP_BLOCK):
                passed, P = _through_gap(Stretch(first, stop, ()), filters, x, P)
                yield _led_on(passed, filters)
                x = passed.piece.end
            continue
        engine = filters.engines[stretch.channels]
        excess = symmetric(P - engine.at(stretch.start).P)
        x = _settled(read, stretch, engine, x, excess, max(beginning, lag))
        excess = told_apart(excess, _told(engine, stretch, max(beginning, lag)))
        for first, stop in _blocks(stretch, BLOCK if engine.invariant else lag):
            ahead = min(stop + lag, stretch.stop)
            piece = engine.forward(first, read(first, ahead, stretch.channels), x)
            yield _looked_back(engine, piece, stretch, excess, stop - first, lag)
            x = engine.forward(first, read(first, stop, stretch.channels), x).end
        P = _at_end(engine, excess, stretch)


def _looked_back(engine: Engine, piece: Piece, stretch: Stretch, excess: Array, count: int, lag: int) -> Estimates:
    """The first `count` samples of a piece, each given `lag` samples more or what there is."""
    outputs = engine.backward_with_lag(piece, count, lag)
    own = piece.begun(count, engine.marks(piece.first, count))
    rows, marks = _rows(engine, own)
    steady = engine.at(piece.first)
    P, L, total = steady.P, steady.L, steady.all_information
    floor = _variance(rows, P) - _variance(rows @ P, total)
    at = np.arange(count)
    left = np.minimum(len(piece.predicted) - 1 - at, lag)
    after = piece.first - stretch.start
    edges = [
        (decay(rows @ P @ L.T, L.T, total, lag + 1, floor), left),
        (decay(rows - (rows @ P) @ total, L, excess, after + count, floor), at + after),
    ]
    return _estimates(engine, own, outputs, marks, True, stretch, edges)


def smoothed(read: Reader, stretches: Sequence[Stretch], filters: Filters, beginning: int) -> Iterator[Estimates]:
    """Loads given the whole record.

    The state at the beginning of a stretch is told by the memory of the filter and no less than `beginning` samples
    where the filter does not change with time, by `beginning` samples where it does.
    """
    ahead = max((_memory(filters.engines[s.channels].at(s.start)) for s in stretches if s.channels), default=1)
    waiting: deque[_Passed] = deque()
    for passed in _forward(read, stretches, filters, ahead, beginning):
        waiting.append(passed)
        while _length(waiting) - len(waiting[0].piece.predicted) >= ahead:
            yield _first_smoothed(waiting, filters)
    yield from _all_smoothed(waiting, filters)


def _length(waiting: Iterable[_Passed]) -> int:
    return sum(len(one.piece.predicted) for one in waiting)


def _blocks(stretch: Stretch, block: int) -> Iterator[tuple[int, int]]:
    for first in range(stretch.start, stretch.stop, block):
        yield first, min(first + block, stretch.stop)


def _memory(steady: SteadyFilter) -> int:
    """Samples beyond which nothing tells of an output any more."""
    rows = steady.outputs @ steady.P
    base = np.diag(rows @ steady.outputs.T)
    power, count = steady.L, 1
    while count < LONGEST_MEMORY:
        there = rows @ power.T
        if np.all(_variance(there, steady.all_information) <= FORGOTTEN * base):
            break
        power, count = power @ power, 2 * count
    return count


def _variance(rows: Array, covariance: Array) -> Array:
    """diag(rows covariance rows')."""
    return np.asarray(np.einsum("on,on->o", rows @ covariance, rows))


def _estimates(
    engine: Engine,
    piece: Piece,
    outputs: Outputs,
    marks: Marks | None,
    smooth: bool,
    stretch: Stretch,
    added: Sequence[tuple[Decay, NDArray[np.intp]]],
) -> Estimates:
    """With the steady variance and what edges add to it, each at its numbers (n,) of samples from the edge."""
    m = piece.predicted.shape[1]
    variance = engine.variance(piece.first, len(piece.predicted), smooth)
    for one, at in added:
        variance = variance + one.after(at)[:, :m]
    marked = None
    if marks is not None and outputs.marked is not None:
        spread = np.tile(marks.smoothed if smooth else marks.updated, (len(marks.samples), 1))
        for one, at in added:
            spread = spread + one.after(at[marks.samples])[:, m:]
        marked = Marked(piece.first + marks.samples, outputs.marked, np.maximum(spread, 0.0))
    innovations = engine.whitened(piece)
    return Estimates(piece.first, outputs.loads, np.maximum(variance, 0.0), marked, innovations, stretch.channels)


def _led_on(passed: _Passed, filters: Filters) -> Estimates:
    """A block of a gap, given what was before it."""
    variance = np.array([_variance(filters.outputs, P) for P in _covariances(passed, filters)])
    piece = passed.piece
    return Estimates(piece.first, piece.predicted, variance, None, piece.innovation, ())


def _at_end(engine: Engine, excess: Array, stretch: Stretch) -> Array:
    """Covariance of the state after a stretch: P + L^n D L^n'."""
    last = engine.at(stretch.stop - 1)
    power = np.linalg.matrix_power(last.L, stretch.stop - stretch.start)
    return symmetric(last.P + power @ excess @ power.T)


def _forward(
    read: Reader, stretches: Sequence[Stretch], filters: Filters, ahead: int, beginning: int
) -> Iterator[_Passed]:
    x, P = np.zeros(len(filters.prior)), filters.prior
    for stretch in stretches:
        if not stretch.channels:
            for first, stop in _blocks(stretch, GAP_BLOCK):
                passed, P = _through_gap(Stretch(first, stop, ()), filters, x, P)
                yield passed
                x = passed.piece.end
            continue
        engine = filters.engines[stretch.channels]
        known = symmetric(P - engine.at(stretch.start).P)
        # The memory of the loads says nothing of offsets, which take the steady gain far longer to find.
        x = _settled(read, stretch, engine, x, known, max(ahead, beginning) if engine.invariant else beginning)
        excess: Array | None = known
        for first, stop in _blocks(stretch, BLOCK):
            piece = engine.forward(first, read(first, stop, stretch.channels), x)
            yield _Passed(stretch, piece, excess)
            x, excess = piece.end, None
        P = _at_end(engine, told_apart(known, _told(engine, stretch, stretch.stop - stretch.start)), stretch)


def _told(engine: Engine, stretch: Stretch, samples: int) -> Array:
    """What so many samples of a stretch tell of the state at its start (N, N)."""
    steady = engine.at(stretch.start)
    return accumulated(steady.L, steady.information, min(samples, stretch.stop - stretch.start))


def _settled(read: Reader, stretch: Stretch, engine: Engine, x: Array, excess: Array, ahead: int) -> Array:
    """The state at the start of a stretch, given what the samples after it tell: x + d with d = D rho[0].

    One Newton step is exact where the engine does not change with time; where it does, O is that of the speed at hand,
    and a few do.
    """
    count = min(ahead, stretch.stop - stretch.start)
    y = read(stretch.start, stretch.start + count, stretch.channels)
    slope = np.eye(len(x)) + excess @ _told(engine, stretch, count)
    found = np.zeros_like(x)
    for _ in range(1 if engine.invariant else CORRECTIONS):
        piece = engine.forward(stretch.start, y, x + found)
        rho = engine.backward(piece, np.zeros_like(x))[1]
        found = found + np.linalg.solve(slope, excess @ rho - found)
    return np.asarray(x + found)


def _first_smoothed(waiting: deque[_Passed], filters: Filters) -> Estimates:
    """The first block that waits, smoothed by all of them, and forgotten."""
    rho, J = np.zeros(len(filters.prior)), np.zeros_like(filters.prior)
    estimates = None
    for passed in reversed(waiting):
        estimates, rho, J = _smoothed_block(passed, filters, rho, J)
    waiting.popleft()
    assert estimates is not None
    return estimates


def _all_smoothed(waiting: deque[_Passed], filters: Filters) -> Iterator[Estimates]:
    rho, J = np.zeros(len(filters.prior)), np.zeros_like(filters.prior)
    found = []
    for passed in reversed(waiting):
        estimates, rho, J = _smoothed_block(passed, filters, rho, J)
        found.append(estimates)
    yield from reversed(found)


def _smoothed_block(passed: _Passed, filters: Filters, rho: Array, J: Array) -> tuple[Estimates, Array, Array]:
    """One block, with rho and the information J (N, N) at its end; both at its start."""
    if passed.covariance is not None:
        return _smoothed_gap(passed, filters, rho, J)
    piece, count = passed.piece, len(passed.piece.predicted)
    engine = filters.engines[passed.stretch.channels]
    steady = engine.at(piece.first)
    total, P, L = steady.all_information, steady.P, steady.L
    outputs, rho = engine.backward(piece, rho)
    rows, marks = _rows(engine, piece)
    floor = _variance(rows, P) - _variance(rows @ P, total)
    at = np.arange(count)
    missing, power = total - J, np.linalg.matrix_power(L, count)
    J = symmetric(total - power.T @ missing @ power)
    if passed.excess is None:
        added = [(decay(rows @ P @ L.T, L.T, missing, count, floor), at[::-1])]
    else:
        start = told_apart(passed.excess, J)
        J = symmetric(seen_through(passed.excess, J))
        if count < SHORT:
            added = [(between_edges(rows, steady, missing, start, count), at)]
        else:
            added = [
                (decay(rows @ P @ L.T, L.T, missing, count, floor), at[::-1]),
                (decay(rows - (rows @ P) @ total, L, start, count, floor), at),
            ]
    return _estimates(engine, piece, outputs, marks, True, passed.stretch, added), rho, J


def _through_gap(stretch: Stretch, filters: Filters, x: Array, P: Array) -> tuple[_Passed, Array]:
    """The state led on through a block of a gap, and its covariance after it."""
    states = [x]
    for k in range(stretch.start, stretch.stop):
        states.append(filters.coast.step(k, states[-1]))
    predicted = np.array(states[:-1]) @ filters.outputs.T
    piece = Piece(stretch.start, np.zeros((len(predicted), 0)), predicted, states[-1])
    passed = _Passed(stretch, piece, covariance=P)
    *_, last = _covariances(passed, filters, beyond=True)
    return passed, last


def _covariances(passed: _Passed, filters: Filters, beyond: bool = False) -> Iterator[Array]:
    """Covariance (N, N) at every sample of a gap, `beyond` at the one after it too."""
    P = passed.covariance
    assert P is not None
    for k in range(passed.stretch.start, passed.stretch.stop):
        yield P
        moved = filters.coast.step(k, P)
        P = symmetric(filters.coast.step(k, moved.T) + filters.noise)
    if beyond:
        yield P


def _smoothed_gap(passed: _Passed, filters: Filters, rho: Array, J: Array) -> tuple[Estimates, Array, Array]:
    """A block of a gap: what comes after it tells, through the model, of what went on in it."""
    outputs, variance = passed.piece.predicted.copy(), np.empty_like(passed.piece.predicted)
    first, U = passed.stretch.start, filters.outputs
    for i, P in reversed(list(enumerate(_covariances(passed, filters)))):
        rho = filters.coast.back(first + i, rho)
        J = symmetric(filters.coast.back(first + i, filters.coast.back(first + i, J).T))
        spread = U @ P
        outputs[i] += spread @ rho
        variance[i] = np.maximum(np.sum(spread * U, axis=1) - _variance(spread, J), 0.0)
    return Estimates(first, outputs, variance, None, passed.piece.innovation, ()), rho, J
