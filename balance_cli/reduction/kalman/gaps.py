"""Gaps of a record, through which the model alone leads the state."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from balance_cli.reduction.kalman.riccati import symmetric
from balance_cli.reduction.kalman.segments import Estimates, Filters, Passed, Stretch, variance_of
from balance_cli.reduction.kalman.steady_filter import Piece

Array = NDArray[np.float64]

GAP_BLOCK = 128
"""Samples of a gap whose covariances are held at once."""


def through_gap(stretch: Stretch, filters: Filters, x: Array, P: Array) -> tuple[Passed, Array]:
    """The state led on through a block of a gap, and its covariance after it."""
    states = [x]
    for k in range(stretch.start, stretch.stop):
        states.append(filters.coast.step(k, states[-1]))
    predicted = np.array(states[:-1]) @ filters.outputs.T
    piece = Piece(stretch.start, np.zeros((len(predicted), 0)), predicted, states[-1])
    passed = Passed(stretch, piece, covariance=P)
    *_, last = covariances(passed, filters, beyond=True)
    return passed, last


def led_on(passed: Passed, filters: Filters) -> Estimates:
    """A block of a gap, given what was before it."""
    variance = np.array([variance_of(filters.outputs, P) for P in covariances(passed, filters)])
    piece = passed.piece
    return Estimates(piece.first, piece.predicted, variance, None, piece.innovation, ())


def covariances(passed: Passed, filters: Filters, beyond: bool = False) -> Iterator[Array]:
    """Covariance (N, N) at every sample of a gap, `beyond` at the one after it too."""
    P = passed.covariance
    assert P is not None
    for k in range(passed.stretch.start, passed.stretch.stop):
        yield P
        moved = filters.coast.step(k, P)
        P = symmetric(filters.coast.step(k, moved.T) + filters.noise)
    if beyond:
        yield P


def smoothed_gap(passed: Passed, filters: Filters, rho: Array, J: Array) -> tuple[Estimates, Array, Array]:
    """A block of a gap: what comes after it tells, through the model, of what went on in it."""
    outputs, variance = passed.piece.predicted.copy(), np.empty_like(passed.piece.predicted)
    first, U = passed.stretch.start, filters.outputs
    for i, P in reversed(list(enumerate(covariances(passed, filters)))):
        rho = filters.coast.back(first + i, rho)
        J = symmetric(filters.coast.back(first + i, filters.coast.back(first + i, J).T))
        spread = U @ P
        outputs[i] += spread @ rho
        variance[i] = np.maximum(np.sum(spread * U, axis=1) - variance_of(spread, J), 0.0)
    return Estimates(first, outputs, variance, None, passed.piece.innovation, ()), rho, J
