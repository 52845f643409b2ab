"""The filters of one run, from its load model, its measured system and the azimuth of its rotor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.reduction.kalman.augmented_model import MeasuredSystem, initial_covariance, sampled_system
from balance_cli.reduction.kalman.azimuth_locked import AzimuthLockedFilter, OscillatorStates, rotation_matrix
from balance_cli.reduction.kalman.channel_filter import ChannelFilter
from balance_cli.reduction.kalman.discretization import SampledModel
from balance_cli.reduction.kalman.load_models import LoadLayer, Oscillators
from balance_cli.reduction.kalman.segments import RunFilters, Segment
from balance_cli.reduction.kalman.steady_filter import SteadyFilter
from balance_cli.signals.rotor.azimuth import Azimuth

Array = NDArray[np.float64]

SPEED_STEP = 0.3
"""Step [Hz] of the grid of speeds at which gains are computed: 2 % of a rotor at 17.5 Hz, less than the width of a
resonance with a damping ratio of 1 %."""
CONSTANT_SPEED_RANGE = 0.02
"""Range [Hz] of the speed within which a single gain serves: 0.1 % of a rotor at 17.5 Hz."""
MAX_GRID_SPEEDS = 9
"""Speeds of the grid at most: each costs a Riccati equation; for larger ranges the grid is coarser."""


@dataclass(frozen=True)
class TimeInvariantPredictor:
    """Prediction by a time-invariant model."""

    F: Array

    def step(self, k: int, x: Array) -> Array:
        """Return the state F x after step k, or a matrix of them."""
        return np.asarray(self.F @ x)

    def back(self, k: int, rho: Array) -> Array:
        """Return the adjoint state F' rho before step k."""
        return np.asarray(self.F.T @ rho)


@dataclass(frozen=True)
class AzimuthLockedPredictor:
    """Prediction by a model with oscillators: F at the mean speed, except that the pairs follow the azimuth."""

    F: Array
    oscillator_states: OscillatorStates

    def _at(self, k: int) -> Array:
        F, s = self.F.copy(), self.oscillator_states.states
        F[s, s] = rotation_matrix(self.oscillator_states.phasors(k, 1)[0])
        return F

    def step(self, k: int, x: Array) -> Array:
        """Return the state F x after step k, or a matrix of them."""
        return np.asarray(self._at(k) @ x)

    def back(self, k: int, rho: Array) -> Array:
        """Return the adjoint state F' rho before step k."""
        return np.asarray(self._at(k).T @ rho)


def time_invariant_filters(
    system: MeasuredSystem, layers: Sequence[LoadLayer], step_loads: Array, segments: Sequence[Segment]
) -> RunFilters:
    """Return filters for random loads, a steady one for each set of channels.

    `step_loads` (m,): size of loads that may begin to act with the record.
    """
    model = sampled_system(system, layers)
    prior = initial_covariance(system, layers, step_loads)
    size = np.sqrt(np.diag(prior))
    model = model.scaled(size)
    channel_filters: dict[tuple[int, ...], ChannelFilter] = {
        channels: SteadyFilter(_select_channels(model, channels)) for channels in _channel_sets(segments)
    }
    return RunFilters(channel_filters, TimeInvariantPredictor(model.F), model.Q, prior / np.outer(size, size), model.U)


def azimuth_locked_filters(
    system: MeasuredSystem,
    layers: Sequence[LoadLayer],
    oscillators: Oscillators,
    step_loads: Array,
    azimuth: Azimuth,
    segments: Sequence[Segment],
) -> RunFilters:
    """Return filters for rotor harmonics and random loads.

    The pairs of the oscillators, harmonic after harmonic for one load after another, are outputs in the middle of every
    revolution. `step_loads` (m,): size of loads that may begin to act with the record.
    """
    speeds = _speed_grid(azimuth)
    at_mean = sampled_system(system, [*layers, oscillators.at(azimuth.mean_rate)])
    starting = oscillators.with_stationary_drift().at(float(azimuth.speed(azimuth.first)))
    prior = initial_covariance(system, [*layers, starting], step_loads)
    size = np.sqrt(np.diag(prior))
    oscillator_states = _build_oscillator_states(system, layers, oscillators, azimuth, size)
    models = [sampled_system(system, [*layers, oscillators.at(float(speed))]).scaled(size) for speed in speeds]
    marks = _mid_revolution_samples(azimuth, system)
    channel_filters: dict[tuple[int, ...], ChannelFilter] = {
        channels: AzimuthLockedFilter(_steady_filters(models, channels), speeds, oscillator_states, marks)
        for channels in _channel_sets(segments)
    }
    scaled = at_mean.scaled(size)
    predictor = AzimuthLockedPredictor(scaled.F, oscillator_states)
    return RunFilters(channel_filters, predictor, scaled.Q, prior / np.outer(size, size), scaled.U)


def _mid_revolution_samples(azimuth: Azimuth, system: MeasuredSystem) -> NDArray[np.intp]:
    """Return the samples nearest to the middle of each revolution."""
    middle = azimuth.time_of(np.arange(azimuth.turns) + 0.5)
    return np.rint((middle - system.state_lead_time) / system.step).astype(np.intp)


def _channel_sets(segments: Sequence[Segment]) -> set[tuple[int, ...]]:
    return {s.channels for s in segments if s.channels}


def _select_channels(model: SampledModel, channels: tuple[int, ...]) -> SampledModel:
    return model.with_channels(np.eye(len(model.H))[list(channels)])


def _steady_filters(models: Sequence[SampledModel], channels: tuple[int, ...]) -> tuple[SteadyFilter, ...]:
    return tuple(SteadyFilter(_select_channels(model, channels)) for model in models)


def _speed_grid(azimuth: Azimuth) -> Array:
    speed = azimuth.speed(np.linspace(azimuth.first, azimuth.last, 512))
    if np.ptp(speed) <= CONSTANT_SPEED_RANGE:
        return np.array([speed.mean()])
    count = int(np.clip(np.ceil(np.ptp(speed) / SPEED_STEP) + 1, 2, MAX_GRID_SPEEDS))
    return np.linspace(speed.min(), speed.max(), count)


def _first_oscillator_state(system: MeasuredSystem, layers: Sequence[LoadLayer]) -> int:
    return system.balance_order + sum(len(layer.matrices()[0]) for layer in layers)


def _build_oscillator_states(
    system: MeasuredSystem, layers: Sequence[LoadLayer], oscillators: Oscillators, azimuth: Azimuth, size: Array
) -> OscillatorStates:
    first = _first_oscillator_state(system, layers)

    def psi(sample: Array) -> Array:
        return np.asarray(2 * np.pi * azimuth.extrapolated_count(sample * system.step + system.state_lead_time))

    orders = np.tile(np.array(oscillators.orders, float), oscillators.drift.shape[1])
    return OscillatorStates(first, orders, size[first : first + 2 * len(orders)], psi, system.step)
