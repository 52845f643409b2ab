"""Filters: loads given each sample and those before it, or a few after it too."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from balance_cli.reduction.kalman.edge_variance import Decay, decay, told_apart
from balance_cli.reduction.kalman.gaps import GAP_BLOCK, led_on, through_gap
from balance_cli.reduction.kalman.riccati import symmetric
from balance_cli.reduction.kalman.segments import (
    Estimates,
    Filters,
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
from balance_cli.reduction.kalman.steady_filter import Engine, Piece

Array = NDArray[np.float64]


def filtered(read: Reader, stretches: Sequence[Stretch], filters: Filters, beginning: int) -> Iterator[Estimates]:
    """Loads given each sample and those before it.

    The state at the beginning of the record is that which the first `beginning` samples tell: the gain is steady from
    there on, and what a record begins with would take it long to forget.
    """
    x, P = np.zeros(len(filters.prior)), filters.prior
    for stretch in stretches:
        if not stretch.channels:
            for first, stop in blocks(stretch, GAP_BLOCK):
                passed, P = through_gap(Stretch(first, stop, ()), filters, x, P)
                yield led_on(passed, filters)
                x = passed.piece.end
            continue
        engine = filters.engines[stretch.channels]
        excess = symmetric(P - engine.at(stretch.start).P)
        if stretch is stretches[0]:
            x = settled(read, stretch, engine, x, excess, beginning)
            excess = told_apart(excess, told(engine, stretch, beginning))
        for first, stop in blocks(stretch):
            piece = engine.forward(first, read(first, stop, stretch.channels), x)
            x = piece.end
            yield _updated(engine, piece, stretch, excess)
        P = engine.at(stretch.stop - 1).P + excess_at_end(engine, excess, stretch)


def _updated(engine: Engine, piece: Piece, stretch: Stretch, excess: Array) -> Estimates:
    """What the filter says of a block of a stretch that began with this excess."""
    count = len(piece.predicted)
    steady = engine.at(stretch.start, count)
    rows, marks = output_rows(engine, piece)
    after = rows - (rows @ steady.update_gain) @ steady.model.H
    fading = decay(after, steady.L, excess, piece.first - stretch.start + count, variance_of(rows, steady.P))
    added = (fading, np.arange(count) + piece.first - stretch.start)
    return estimates_of(engine, piece, engine.updated(piece), marks, False, stretch, [added])


def lagged(
    read: Reader, stretches: Sequence[Stretch], filters: Filters, beginning: int, lag: int
) -> Iterator[Estimates]:
    """Loads given each sample and `lag` samples after it, those before it too; as `filtered` otherwise.

    Of a filter that changes with time each knows up to twice as many. Nobody looks across a gap.
    """
    x, P = np.zeros(len(filters.prior)), filters.prior
    for stretch in stretches:
        if not stretch.channels:
            for first, stop in blocks(stretch, GAP_BLOCK):
                passed, P = through_gap(Stretch(first, stop, ()), filters, x, P)
                yield led_on(passed, filters)
                x = passed.piece.end
            continue
        engine = filters.engines[stretch.channels]
        excess = symmetric(P - engine.at(stretch.start).P)
        x = settled(read, stretch, engine, x, excess, max(beginning, lag))
        edges = _Edges(engine, stretch, told_apart(excess, told(engine, stretch, max(beginning, lag))), lag)
        for first, stop in blocks(stretch):
            piece = engine.forward(first, read(first, stop, stretch.channels), x)
            x = piece.end
            if stop < stretch.stop:
                ahead = engine.forward(stop, read(stop, min(stop + lag, stretch.stop), stretch.channels), x)
                piece = piece.with_innovations(ahead.innovation)
            yield edges.looked_back(piece, stop - first)
        P = engine.at(stretch.stop - 1).P + excess_at_end(engine, edges.excess, stretch)


@dataclass(frozen=True)
class _Edges:
    """A stretch that is looked at with a lag: what its beginning and its end add to the variance of an output."""

    engine: Engine
    stretch: Stretch
    excess: Array
    lag: int

    def looked_back(self, piece: Piece, count: int) -> Estimates:
        """The first `count` samples of a piece, each given `lag` samples more or what there is."""
        outputs = self.engine.backward_with_lag(piece, count, self.lag)
        own = replace(piece, innovation=piece.innovation[:count])
        _, marks = output_rows(self.engine, own)
        at, (ends, starts) = np.arange(count), self._decays
        added = [
            (ends, np.minimum(len(piece.innovation) - 1 - at, self.lag)),
            (starts, at + piece.first - self.stretch.start),
        ]
        return estimates_of(self.engine, own, outputs, marks, True, self.stretch, added)

    @cached_property
    def _decays(self) -> tuple[Decay, Decay]:
        """Towards the samples that are not known yet, and from the beginning on, at the mean speed of the stretch."""
        whole = self.stretch.stop - self.stretch.start
        steady, marks = self.engine.at(self.stretch.start, whole), self.engine.marks(self.stretch.start, 1)
        rows = steady.outputs if marks is None else np.vstack([steady.outputs, marks.rows])
        P, L, total = steady.P, steady.L, steady.all_information
        floor = variance_of(rows, P) - variance_of(rows @ P, total)
        return (
            decay(rows @ P @ L.T, L.T, total, self.lag + 1, floor),
            decay(rows - (rows @ P) @ total, L, self.excess, whole, floor),
        )
