"""Balance and loads as one model from sample to sample, in units in which its noise is plain.

The loads drive the anti-alias filter, that the balance (the two commute, and six filters are fewer than fifteen), and
that the channels' own filters; late channels follow. States are in units of their own size, channels in units of their
noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.model.state_space import StateSpace
from balance_cli.reduction.kalman.discretization import ContinuousModel, SampledModel, discretize
from balance_cli.reduction.kalman.load_models import LoadLayer, combine_layers
from balance_cli.reduction.kalman.riccati import discrete_gramian

Array = NDArray[np.float64]

OFFSET_AVERAGING_TIME = 10.0
"""Time [s] over which an offset is averaged."""
OFFSET_FORGETTING_TIME = 1000.0
"""Time [s] in which an offset is forgotten: that of a channel that is not read must not grow without end."""


@dataclass(frozen=True)
class MeasuredSystem:
    """A balance as it is sampled: `space` with the anti-alias filter, the columns of the loads that it carries,

    `step` [s], and the variance `noise` (c,) [V2] of a sample of its channels. `offset` (z,) [V] is the size of the
    offset of each of the space's channels, 0 where none is looked for.
    """

    space: StateSpace
    columns: tuple[int, ...]
    step: float
    noise: Array
    offset: Array

    @property
    def state_lead_time(self) -> float:
        """Time [s] from a sample to the instant that states then refer to: not zero where a channel runs early."""
        return float(max(-self.space.delay.min(), 0.0))

    @property
    def offset_channels(self) -> NDArray[np.intp]:
        """Channels of the space whose offset is a state."""
        return np.flatnonzero(self.offset > 0)

    @property
    def balance_order(self) -> int:
        """Number of states of balance, channels and anti-alias filter."""
        return len(self.space.A)


def continuous_model(system: MeasuredSystem, layers: Sequence[LoadLayer]) -> ContinuousModel:
    """Loads that drive the balance: states of the balance first, then those of the loads, then offsets of channels.

    An offset drifts as if it were averaged over `OFFSET_AVERAGING_TIME`: by so much in a second as noise leaves it
    uncertain
    then, and no more, for it shares its channel with loads that change as slowly.
    """
    space, offset_channels = system.space, system.offset_channels
    A_load, W_load, U = combine_layers(layers)
    B, D = (matrix[:, system.columns] for matrix in (space.B, space.D))
    n, k, b = len(space.A), len(A_load), len(offset_channels)
    A, W = np.zeros((n + k + b,) * 2), np.zeros((n + k + b,) * 2)
    A[:n, : n + k] = np.hstack([space.A, B @ U])
    A[n : n + k, n : n + k] = A_load
    A[n + k :, n + k :] = -np.eye(b) / OFFSET_FORGETTING_TIME
    W[n : n + k, n : n + k] = W_load
    W[n + k :, n + k :] = np.median(system.noise) * system.step / OFFSET_AVERAGING_TIME**2 * np.eye(b)
    shown = np.zeros((len(space.C), b))
    shown[offset_channels, np.arange(b)] = 1.0
    C = np.hstack([space.C, D @ U, shown])
    return ContinuousModel(
        A, W, C, space.delay + system.state_lead_time, np.hstack([np.zeros((len(U), n)), U, np.zeros((len(U), b))])
    )


def sampled_system(system: MeasuredSystem, layers: Sequence[LoadLayer]) -> SampledModel:
    """The model from sample to sample, channels mixed and in units of their noise."""
    model = discretize(continuous_model(system, layers), system.step)
    return model.with_channels(system.space.mixing / np.sqrt(system.noise)[:, None])


def initial_covariance(system: MeasuredSystem, layers: Sequence[LoadLayer], step_loads: Array) -> Array:
    """What is known (N, N) before the first sample: loads of their size that have acted for long, offsets of theirs,

    and what balance and filters have in them of loads `held` (m,) that began to act just then. Layers are stationary.
    """
    model = sampled_system(system, layers)
    n, b = system.balance_order, len(system.offset_channels)
    first = n + sum(len(layer.matrices()[0]) for layer in layers)
    moving = np.ones(model.order, bool)
    moving[first : first + b] = False
    F, Q = model.F[np.ix_(moving, moving)], model.Q[np.ix_(moving, moving)]
    P = np.zeros_like(model.F)
    P[np.ix_(moving, moving)] = discrete_gramian(F.T, Q)
    P[~moving, ~moving] = system.offset[system.offset_channels] ** 2
    states = -np.linalg.solve(system.space.A, system.space.B[:, list(system.columns)]) * step_loads
    P[:n, :n] += states @ states.T + np.diag(np.sum(states**2, axis=1))
    # One step on, what late channels hold is filled in.
    return model.F @ P @ model.F.T + model.Q
