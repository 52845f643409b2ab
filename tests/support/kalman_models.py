"""Small models, and their estimates by Gaussian conditioning without any recursion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.reduction.kalman.discretization import SampledModel
from balance_cli.reduction.kalman.riccati import discrete_gramian
from balance_cli.reduction.kalman.segments import RunFilters, Segment
from balance_cli.reduction.kalman.steady_filter import SteadyFilter

Array = NDArray[np.float64]


def small_model(seed: int = 1) -> SampledModel:
    """Return a model of a drifting load, a lightly damped oscillator that it drives, and three channels."""
    rng = np.random.default_rng(seed)
    turn, decay = 0.7, 0.93
    c, s = decay * np.cos(turn), decay * np.sin(turn)
    F = np.array([[c, s, 0.3, 0.1], [-s, c, 0.2, 0.0], [0.0, 0.0, 0.95, 0.1], [0.0, 0.0, 0.0, 0.8]])
    G = np.array([[0.1, 0.0], [0.0, 0.1], [0.5, 0.0], [0.2, 0.4]])
    H = 3.0 * rng.standard_normal((3, 4))
    U = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 1.0, 2.0]])
    return SampledModel(F, G @ G.T, H, U)


@dataclass(frozen=True)
class TimeInvariantPredictor:
    """Prediction by a time-invariant model."""

    F: Array

    def step(self, k: int, x: Array) -> Array:
        """One sample on."""
        return self.F @ x

    def back(self, k: int, rho: Array) -> Array:
        """One sample back."""
        return self.F.T @ rho


def steady_filters(model: SampledModel, segments: tuple[Segment, ...]) -> RunFilters:
    """The steady filter for each set of channels, and the stationary covariance to begin with."""
    channel_filters = {
        s.channels: SteadyFilter(model.with_channels(np.eye(len(model.H))[list(s.channels)]))
        for s in segments
        if s.channels
    }
    return RunFilters(
        channel_filters, TimeInvariantPredictor(model.F), model.Q, discrete_gramian(model.F.T, model.Q), model.U
    )


def draw_samples(model: SampledModel, samples: int, seed: int = 0) -> tuple[Array, Array]:
    """Channels (n, c) and outputs (n, o) of a stationary model, drawn at random."""
    rng = np.random.default_rng(seed)
    root = np.linalg.cholesky(model.Q + 1e-15 * np.eye(model.order))
    x = np.linalg.cholesky(discrete_gramian(model.F.T, model.Q)) @ rng.standard_normal(model.order)
    y, u = np.empty((samples, len(model.H))), np.empty((samples, len(model.U)))
    for k in range(samples):
        y[k], u[k] = model.H @ x + rng.standard_normal(len(model.H)), model.U @ x
        x = model.F @ x + root @ rng.standard_normal(model.order)
    return y, u


def condition_on_samples(
    model: SampledModel, y: Array, read: NDArray[np.bool_], until: Array | None = None
) -> tuple[Array, Array]:
    """Mean and variance (n, o) of the outputs given the samples of y (n, c) that were `read`, by dense algebra.

    `until` (n,): the last sample that each output may know; all by default.
    """
    n, N = len(y), model.order
    X = discrete_gramian(model.F.T, model.Q)
    powers = np.stack([np.linalg.matrix_power(model.F, k) for k in range(n)])
    states = np.empty((n, N, n, N))
    for i in range(n):
        for j in range(n):
            states[i, :, j, :] = powers[i - j] @ X if i >= j else X @ powers[j - i].T
    states = states.reshape(n * N, n * N)
    H, U = np.kron(np.eye(n), model.H)[read.ravel()], np.kron(np.eye(n), model.U)
    joint = H @ states @ H.T + np.eye(len(H))
    cross = U @ states @ H.T
    known = np.repeat(np.arange(n), y.shape[1])[read.ravel()]
    mean, variance = np.empty(n * len(model.U)), np.empty(n * len(model.U))
    prior = np.einsum("an,nm,am->a", U, states, U)
    last = np.repeat(np.full(n, n) if until is None else until, len(model.U))
    for limit in np.unique(last):
        mine, selected = last == limit, known <= limit
        gain = np.linalg.solve(joint[np.ix_(selected, selected)], cross[np.ix_(mine, selected)].T).T
        mean[mine] = gain @ y.ravel()[read.ravel()][selected]
        variance[mine] = prior[mine] - np.sum(gain * cross[np.ix_(mine, selected)], axis=1)
    return mean.reshape(n, -1), variance.reshape(n, -1)


def conditional_variance(model: SampledModel, read: NDArray[np.bool_]) -> Array:
    """Variance (n, o) of the outputs given the samples that were `read` (n, c), as sums of squares.

    The states are linear in white noise w, whose covariance given the samples is (1 + B'B)^-1 = (R'R)^-1.
    """
    n, N = len(read), model.order
    start, root = (np.linalg.cholesky(X) for X in (discrete_gramian(model.F.T, model.Q), model.Q + 1e-15 * np.eye(N)))
    states = np.zeros((n, N, n * N))
    states[0, :, :N] = start
    for k in range(1, n):
        states[k] = model.F @ states[k - 1]
        states[k, :, k * N : (k + 1) * N] = root
    B = np.concatenate([(model.H @ states[k])[read[k]] for k in range(n)])
    R = np.linalg.qr(np.vstack([np.eye(n * N), B]), mode="r")
    return np.array([np.sum(np.linalg.solve(R.T, (model.U @ x).T) ** 2, axis=0) for x in states])
