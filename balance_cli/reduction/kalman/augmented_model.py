"""The augmented model: balance, loads and channel offsets in one state vector, from sample to sample.

The loads drive the anti-alias filter, its output the balance, and the balance the filters of the channels; delays come
last. Anti-alias filter and balance commute, and six filters of loads are fewer than those of all channels. States are
in units of their standard deviation, channels in units of their noise.
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
"""Time [s] over which an offset is averaged: well below the length of a record, well above the periods of loads."""
OFFSET_FORGETTING_TIME = 1000.0
"""Decay time [s] of an offset, longer than a record; it bounds the variance of the offset of a channel not in use."""


@dataclass(frozen=True)
class MeasuredSystem:
    """A sampled balance: state space with the anti-alias filter, and the columns of the loads that it carries.

    `step` [s] between samples; `noise` (c,) [V2]: variance of one sample of each channel; `offset` (z,) [V]: standard
    deviation of the offset of each channel of the space, 0 for channels without one.
    """

    space: StateSpace
    columns: tuple[int, ...]
    step: float
    noise: Array
    offset: Array

    @property
    def state_lead_time(self) -> float:
        """Time [s] from a sample to the instant of its states: not zero where a channel has a negative delay."""
        return float(max(-self.space.delay.min(), 0.0))

    @property
    def offset_channels(self) -> NDArray[np.intp]:
        """Indices of the channels of the space whose offset is a state."""
        return np.flatnonzero(self.offset > 0)

    @property
    def balance_order(self) -> int:
        """Number of states of balance, channels and anti-alias filter."""
        return len(self.space.A)


def continuous_model(system: MeasuredSystem, layers: Sequence[LoadLayer]) -> ContinuousModel:
    """Return the continuous model; states: those of the balance, those of the loads, offsets of channels.

    The drift of an offset corresponds to averaging over `OFFSET_AVERAGING_TIME`: in one second it equals the
    uncertainty that noise leaves after such an average. More drift would absorb slowly changing loads.
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
    offset_columns = np.zeros((len(space.C), b))
    offset_columns[offset_channels, np.arange(b)] = 1.0
    C = np.hstack([space.C, D @ U, offset_columns])
    return ContinuousModel(
        A, W, C, space.delay + system.state_lead_time, np.hstack([np.zeros((len(U), n)), U, np.zeros((len(U), b))])
    )


def sampled_system(system: MeasuredSystem, layers: Sequence[LoadLayer]) -> SampledModel:
    """Return the model from sample to sample, with the mixing of its channels, in units of their noise."""
    model = discretize(continuous_model(system, layers), system.step)
    return model.with_channels(system.space.mixing / np.sqrt(system.noise)[:, None])


def initial_covariance(system: MeasuredSystem, layers: Sequence[LoadLayer], step_loads: Array) -> Array:
    """Return the prior covariance (N, N) of the first state.

    The loads of the layers, which must be stationary, have acted for long; offsets have their size; and constant loads
    of size `step_loads` (m,) may begin to act with the record.
    """
    model = sampled_system(system, layers)
    n, b = system.balance_order, len(system.offset_channels)
    first = n + sum(len(layer.matrices()[0]) for layer in layers)
    is_dynamic = np.ones(model.order, bool)
    is_dynamic[first : first + b] = False
    F, Q = model.F[np.ix_(is_dynamic, is_dynamic)], model.Q[np.ix_(is_dynamic, is_dynamic)]
    P = np.zeros_like(model.F)
    P[np.ix_(is_dynamic, is_dynamic)] = discrete_gramian(F.T, Q)
    P[~is_dynamic, ~is_dynamic] = system.offset[system.offset_channels] ** 2
    states = -np.linalg.solve(system.space.A, system.space.B[:, list(system.columns)]) * step_loads
    P[:n, :n] += states @ states.T + np.diag(np.sum(states**2, axis=1))
    # One step fills the states that store delayed outputs.
    return model.F @ P @ model.F.T + model.Q
