"""The filters of one run: what is known of its loads, how its channels read them, and its rotor's azimuth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.reduction.kalman.augmented_model import MeasuredSystem, first_covariance, sampled_system
from balance_cli.reduction.kalman.azimuth_locked import AzimuthLockedFilter, Turning, rotations
from balance_cli.reduction.kalman.discretization import SampledModel
from balance_cli.reduction.kalman.load_models import LoadLayer, Oscillators
from balance_cli.reduction.kalman.segments import Filters, Stretch
from balance_cli.reduction.kalman.steady_filter import Engine, SteadyFilter
from balance_cli.signals.azimuth import Azimuth

Array = NDArray[np.float64]

SPEED_STEP = 0.3
"""Step [Hz] of the grid of speeds at which gains are computed."""
STEADY = 0.02
"""Range [Hz] of a speed for which one gain does."""
MOST_SPEEDS = 9


@dataclass(frozen=True)
class StillCoast:
    """Gaps of a model that is the same at all times."""

    F: Array

    def step(self, k: int, x: Array) -> Array:
        """F x."""
        return np.asarray(self.F @ x)

    def back(self, k: int, rho: Array) -> Array:
        """F' rho."""
        return np.asarray(self.F.T @ rho)


@dataclass(frozen=True)
class TurningCoast:
    """Gaps of a model with oscillators: F at the mean speed, but for the turning, which follows the azimuth."""

    F: Array
    turning: Turning

    def _at(self, k: int) -> Array:
        F, s = self.F.copy(), self.turning.states
        F[s, s] = rotations(self.turning.phasors(k, 1)[0])
        return F

    def step(self, k: int, x: Array) -> Array:
        """F x."""
        return np.asarray(self._at(k) @ x)

    def back(self, k: int, rho: Array) -> Array:
        """F' rho."""
        return np.asarray(self._at(k).T @ rho)


def still_filters(
    system: MeasuredSystem, layers: Sequence[LoadLayer], held: Array, stretches: Sequence[Stretch]
) -> Filters:
    """Filters for random loads, a steady one for each set of channels; `held` (m,) may have begun to act."""
    model = sampled_system(system, layers)
    prior = first_covariance(system, layers, held)
    size = np.sqrt(np.diag(prior))
    model = model.scaled(size)
    engines: dict[tuple[int, ...], Engine] = {
        channels: SteadyFilter(_reading(model, channels)) for channels in _sets(stretches)
    }
    return Filters(engines, StillCoast(model.F), model.Q, prior / np.outer(size, size), model.U)


def azimuth_locked_filters(
    system: MeasuredSystem,
    layers: Sequence[LoadLayer],
    oscillators: Oscillators,
    held: Array,
    azimuth: Azimuth,
    stretches: Sequence[Stretch],
) -> Filters:
    """Filters for harmonics of the rotor beside random loads.

    Pairs of the oscillators, harmonic after harmonic for one load after another, are given out in the middle of every
    revolution.
    """
    speeds = _speeds(azimuth)
    at_mean = sampled_system(system, [*layers, oscillators.at(azimuth.mean_rate)])
    starting = oscillators.stationary().at(float(azimuth.speed(azimuth.first)))
    prior = first_covariance(system, [*layers, starting], held)
    size = np.sqrt(np.diag(prior))
    turning = _turning(system, layers, oscillators, azimuth, size)
    models = [sampled_system(system, [*layers, oscillators.at(float(speed))]).scaled(size) for speed in speeds]
    marks = _middles(azimuth, system)
    engines: dict[tuple[int, ...], Engine] = {
        channels: AzimuthLockedFilter(_steady(models, channels), speeds, turning, marks)
        for channels in _sets(stretches)
    }
    scaled = at_mean.scaled(size)
    coast = TurningCoast(scaled.F, turning)
    return Filters(engines, coast, scaled.Q, prior / np.outer(size, size), scaled.U)


def _middles(azimuth: Azimuth, system: MeasuredSystem) -> NDArray[np.intp]:
    """The samples nearest to the middle of each revolution."""
    middle = azimuth.time_of(np.arange(azimuth.turns) + 0.5)
    return np.rint((middle - system.ahead) / system.step).astype(np.intp)


def _sets(stretches: Sequence[Stretch]) -> set[tuple[int, ...]]:
    return {s.channels for s in stretches if s.channels}


def _reading(model: SampledModel, channels: tuple[int, ...]) -> SampledModel:
    return model.seen_by(np.eye(len(model.H))[list(channels)])


def _steady(models: Sequence[SampledModel], channels: tuple[int, ...]) -> tuple[SteadyFilter, ...]:
    return tuple(SteadyFilter(_reading(model, channels)) for model in models)


def _speeds(azimuth: Azimuth) -> Array:
    speed = azimuth.speed(np.linspace(azimuth.first, azimuth.last, 512))
    if np.ptp(speed) <= STEADY:
        return np.array([speed.mean()])
    count = int(np.clip(np.ceil(np.ptp(speed) / SPEED_STEP) + 1, 2, MOST_SPEEDS))
    return np.linspace(speed.min(), speed.max(), count)


def _first_pair(system: MeasuredSystem, layers: Sequence[LoadLayer]) -> int:
    return system.balance_order + sum(len(layer.matrices()[0]) for layer in layers)


def _turning(
    system: MeasuredSystem, layers: Sequence[LoadLayer], oscillators: Oscillators, azimuth: Azimuth, size: Array
) -> Turning:
    first = _first_pair(system, layers)

    def psi(sample: Array) -> Array:
        return np.asarray(2 * np.pi * azimuth.count_beyond(sample * system.step + system.ahead))

    orders = np.tile(np.array(oscillators.orders, float), oscillators.drift.shape[1])
    return Turning(first, orders, size[first : first + 2 * len(orders)], psi, system.step)
