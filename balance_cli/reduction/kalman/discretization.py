"""Exact discretization of a continuous model driven by white noise, with output delays of any length.

Nothing is held between samples: states, their noise and delayed outputs are exact. An output that is delayed by a
fraction of the step is stored at its instant between two samples, on the way of the states to the next sample.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from balance_cli.reduction.kalman.riccati import symmetrize

Array = NDArray[np.float64]

SMALL_STEP = 0.25
"""Largest norm of A h for which the series of a step is summed."""
SERIES_TERMS = 18
"""Terms of the series: the next is smaller than 2 * 0.25^18 / 18!, beyond double precision."""


@dataclass(frozen=True)
class ContinuousModel:
    """x' = A x + noise of intensity W, y_c = C_c x(t - delay_c), u = U x; n states, c channels, m loads.

    A, W (n, n), C (c, n), delay (c,) [s], not negative, U (m, n).
    """

    A: Array
    W: Array
    C: Array
    delay: Array
    U: Array


@dataclass(frozen=True)
class SampledModel:
    """x[k+1] = F x[k] + w, y[k] = H x[k] + v, u[k] = U x[k]: F and Q = E[w w'] (n, n), H (c, n), U (m, n)."""

    F: Array
    Q: Array
    H: Array
    U: Array

    @property
    def order(self) -> int:
        """Number n of states."""
        return len(self.F)

    def scaled(self, size: Array) -> SampledModel:
        """Return the model with its states in units of `size` (n,)."""
        return SampledModel(self.F * size / size[:, None], self.Q / np.outer(size, size), self.H * size, self.U * size)

    def with_channels(self, channels: Array) -> SampledModel:
        """Return the model with combinations `channels` (r, c) of its channels."""
        return replace(self, H=channels @ self.H)


def discretize_step(A: Array, W: Array, time: float) -> tuple[Array, Array]:
    """Return exp(A t) and the noise covariance int exp(A s) W exp(A s)' ds (n, n) of a step.

    The series for a short step, then doubling: Q(2h) = Q(h) + Phi(h) Q(h) Phi(h)', which is stable for fast decays.
    """
    size = float(np.linalg.norm(A, 1)) * time
    halvings = max(int(np.ceil(np.log2(max(size, 1e-300) / SMALL_STEP))), 0)
    h = time / 2**halvings
    term = W * h
    Q = term.copy()
    for i in range(2, SERIES_TERMS):
        term = (A @ term + term @ A.T) * (h / i)
        Q = Q + term
    Phi = np.asarray(scipy.linalg.expm(A * h), float)
    for _ in range(halvings):
        Q, Phi = symmetrize(Q + Phi @ Q @ Phi.T), Phi @ Phi
    return Phi, symmetrize(Q)


def discretize(model: ContinuousModel, step: float) -> SampledModel:
    """Return the model at samples `step` [s] apart; delayed outputs become further states."""
    full_steps, part = np.divmod(np.round(model.delay / step, 9), 1.0)
    n, c = len(model.A), len(model.C)
    counts = full_steps.astype(int) + (part > 0)
    # A delay that is rounded to zero needs no states.
    late = np.flatnonzero(counts)
    first = n + np.concatenate([[0], np.cumsum(counts)[:-1]])
    total = n + int(counts.sum())
    F, Q = np.eye(total), np.zeros((total, total))
    F, Q = _shift_delay_states(F, Q, first, counts)
    reached = 0.0
    for instant in [*sorted({1.0 - p for p in part[late] if p > 0}), 1.0]:
        F, Q = _advance(F, Q, model, (instant - reached) * step)
        reached = instant
        for channel in late:
            if part[channel] > 0 and np.isclose(1.0 - part[channel], instant, rtol=0.0, atol=1e-10):
                F, Q = _store_output(F, Q, int(first[channel]), model.C[channel])
    H = np.zeros((c, total))
    for i in range(c):
        if counts[i]:
            H[i, first[i] + counts[i] - 1] = 1.0
        else:
            H[i, :n] = model.C[i]
    for channel in late:
        if part[channel] == 0:
            F, Q = _store_previous_output(F, Q, int(first[channel]), model.C[channel])
    return SampledModel(F, Q, H, np.hstack([model.U, np.zeros((len(model.U), total - n))]))


def _advance(F: Array, Q: Array, model: ContinuousModel, time: float) -> tuple[Array, Array]:
    """Return the map and its noise continued by a time [s], in which only the states of the model change."""
    n = len(model.A)
    Phi, noise = discretize_step(model.A, model.W, time)
    F, Q = F.copy(), Q.copy()
    F[:n] = Phi @ F[:n]
    Q[:n] = Phi @ Q[:n]
    Q[:, :n] = Q[:, :n] @ Phi.T
    Q[:n, :n] += noise
    return F, Q


def _store_output(F: Array, Q: Array, row: int, C: Array) -> tuple[Array, Array]:
    """Return the map and its noise with an output at this instant stored in a state."""
    n = len(C)
    F, Q = F.copy(), Q.copy()
    F[row] = C @ F[:n]
    Q[row] = C @ Q[:n]
    Q[:, row] = Q[:, :n] @ C
    return F, Q


def _store_previous_output(F: Array, Q: Array, row: int, C: Array) -> tuple[Array, Array]:
    """Return the map and its noise with an output at the previous sample stored in a state (a delay of whole steps)."""
    F, Q = F.copy(), Q.copy()
    F[row], Q[row], Q[:, row] = 0.0, 0.0, 0.0
    F[row, : len(C)] = C
    return F, Q


def _shift_delay_states(F: Array, Q: Array, first: Array, counts: Array) -> tuple[Array, Array]:
    """Return the map and its noise with stored outputs shifted by one state; the first of each output is free."""
    F = F.copy()
    for start, count in zip(first, counts, strict=True):
        for row in range(int(start) + int(count) - 1, int(start), -1):
            F[row] = 0.0
            F[row, row - 1] = 1.0
        if count:
            F[start] = 0.0
    return F, Q
