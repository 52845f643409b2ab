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
from balance_cli.reduction.kalman.riccati import accumulated, symmetric
from balance_cli.reduction.kalman.steady_filter import Engine, Marks, Outputs, Piece

Array = NDArray[np.float64]
Reader = Callable[[int, int, tuple[int, ...]], Array]
"""Samples start to stop of the channels with these numbers, in units of their noise and whitened."""

BLOCK = 32768
"""Samples that go through a filter at a time."""
CORRECTIONS = 2
FORGOTTEN = 1e-8
"""Share of an error at the start of a stretch below which it is of no account any more."""


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


@dataclass(frozen=True)
class Beginning:
    """Of a stretch: what the covariance of its first state has above P, `excess` (N, N), and by how much that state was

    moved (N,) for what the samples after it tell.
    """

    excess: Array
    moved: Array


@dataclass
class Passed:
    """A block after the forward pass.

    `beginning`, where it begins a stretch; `end_excess`, where it ends one: what the covariance after it has above P;
    `covariance`: that at the start of a block of a gap.
    """

    stretch: Stretch
    piece: Piece
    beginning: Beginning | None = None
    end_excess: Array | None = None
    covariance: Array | None = None


def blocks(stretch: Stretch, block: int | None = None, head: int = 0) -> Iterator[tuple[int, int]]:
    """First sample and end of each block of a stretch, the first one no longer than `head` where that is said."""
    block = block or BLOCK
    edges = range(stretch.start + (min(head, block) or block), stretch.stop, block)
    return pairwise([stretch.start, *edges, stretch.stop])


def output_rows(engine: Engine, piece: Piece) -> tuple[Array, Marks | None]:
    """Outputs (m + q, N) of a block: its loads, and what is given out at marked samples."""
    marks = engine.marks(piece.first, len(piece.predicted))
    U = engine.at(piece.first).outputs
    return (U if marks is None else np.vstack([U, marks.rows])), marks


def variance_of(rows: Array, covariance: Array) -> Array:
    """diag(rows covariance rows')."""
    return np.asarray(np.einsum("on,on->o", rows @ covariance, rows))


def estimates_of(
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


def excess_at_end(engine: Engine, excess: Array, stretch: Stretch) -> Array:
    """What the covariance after a stretch has above P: L^n D L^n'."""
    power: Array = np.eye(len(excess))
    for first, count in engine.even_parts(stretch.start, stretch.stop - stretch.start):
        power = np.linalg.matrix_power(engine.at(first, count).L, count) @ power
        if np.abs(power).max() < FORGOTTEN:
            break
    return symmetric(power @ excess @ power.T)


def told(engine: Engine, stretch: Stretch, samples: int) -> Array:
    """What so many samples of a stretch tell of the state at its start (N, N)."""
    information = np.zeros_like(engine.at(stretch.start).L)
    shift: Array = np.eye(len(information))
    for first, count in engine.even_parts(stretch.start, min(samples, stretch.stop - stretch.start)):
        steady = engine.at(first, count)
        information = information + shift.T @ accumulated(steady.L, steady.information, count) @ shift
        shift = np.linalg.matrix_power(steady.L, count) @ shift
        if np.abs(shift).max() < FORGOTTEN:
            break
    return symmetric(information)


def settled(
    read: Reader, stretch: Stretch, engine: Engine, x: Array, excess: Array, ahead: int, steps: int = CORRECTIONS
) -> Array:
    """The state at the start of a stretch, given what the samples after it tell: x + d with d = D rho[0].

    One Newton step is exact where the engine does not change with time; where it does, O is summed over parts of an
    even speed, and a few `steps` do.
    """
    count = min(ahead, stretch.stop - stretch.start)
    y = read(stretch.start, stretch.start + count, stretch.channels)
    slope = np.eye(len(x)) + excess @ told(engine, stretch, count)
    found = np.zeros_like(x)
    for _ in range(1 if engine.invariant else steps):
        piece = engine.forward(stretch.start, y, x + found)
        rho = engine.backward(piece, np.zeros_like(x))[1]
        found = found + np.linalg.solve(slope, excess @ rho - found)
    return np.asarray(x + found)
