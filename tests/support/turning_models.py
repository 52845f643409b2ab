"""A small balance under a rotor of variable speed, its exact filter and smoother, and records drawn from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from balance_cli.model.state_space import StateSpace
from balance_cli.reduction.kalman.augmented_model import MeasuredSystem, initial_covariance, sampled_system
from balance_cli.reduction.kalman.discretization import SampledModel
from balance_cli.reduction.kalman.load_models import LowPassDrift, Oscillators
from balance_cli.reduction.kalman.run_filters import azimuth_locked_filters
from balance_cli.reduction.kalman.segments import RunFilters, Segment
from balance_cli.signals.rotor.azimuth import Azimuth
from tests.support.kalman_models import Array

STEP = 1.0 / 200.0
LAYERS = (LowPassDrift(np.array([0.3, 0.2]), 2.0, 30.0),)
OSCILLATORS = Oscillators(np.full((2, 2), 0.2), np.full((2, 2), 2.0), (1, 2))
HELD = np.ones(2)


def _resonance(frequency: float, damping_ratio: float) -> Array:
    w = 2 * np.pi * frequency
    return np.array([[0.0, w], [-w, -2 * damping_ratio * w]])


def small_balance() -> MeasuredSystem:
    """Return two modes, one within the range of the second harmonic, and three channels, one delayed by 0.4 samples."""
    A = np.zeros((4, 4))
    A[:2, :2], A[2:, 2:] = _resonance(20.0, 0.05), _resonance(55.0, 0.03)
    B, D = np.zeros((4, 6)), np.zeros((3, 6))
    B[1, :2], B[3, :2] = [90.0, 40.0], [-100.0, 250.0]
    D[:, :2] = [[0.3, 0.0], [0.1, -0.2], [0.0, 0.4]]
    C = np.array([[1.0, 0.0, 0.3, 0.0], [0.4, 0.1, 1.0, 0.0], [0.5, 0.0, -0.8, 0.1]])
    space = StateSpace(("a", "b", "c"), A, B, C, D, np.array([0.0, 0.4, 0.0]) * STEP, np.eye(3))
    return MeasuredSystem(space, (0, 1), STEP, np.full(3, 0.05), np.zeros(3))


SYSTEM = small_balance()


def accelerating_azimuth(speed: float, rate: float, duration: float) -> Azimuth:
    """Return the azimuth of a rotor that accelerates from `speed` [Hz] by `rate` [Hz/s]."""
    turns = np.arange(int((speed + rate * duration / 2) * duration) + 4.0)
    time = turns / speed if rate == 0.0 else (np.sqrt(speed**2 + 2 * rate * turns) - speed) / rate
    return Azimuth(time - 0.5 / speed, turns.astype(np.int64))


def locked_filters(azimuth: Azimuth, samples: int) -> tuple[RunFilters, tuple[Segment, ...]]:
    """Return the filters that follow this azimuth, for all channels."""
    segments = (Segment(0, samples, (0, 1, 2)),)
    return azimuth_locked_filters(SYSTEM, LAYERS, OSCILLATORS, HELD, azimuth, segments), segments


def time_varying_models(azimuth: Azimuth, samples: int) -> list[SampledModel]:
    """Return the model of the mean speed from each sample to the next."""
    count = azimuth.extrapolated_count(np.arange(samples + 1) * STEP)
    return [sampled_system(SYSTEM, [*LAYERS, OSCILLATORS.at(speed)]) for speed in np.diff(count) / STEP]


def prior_covariance(azimuth: Azimuth) -> Array:
    """Return the covariance of the first state."""
    starting = OSCILLATORS.with_stationary_drift().at(float(azimuth.speed(azimuth.first)))
    return initial_covariance(SYSTEM, [*LAYERS, starting], HELD)


def draw_records(
    models: Sequence[SampledModel], prior: Array, records: int, seed: int = 0
) -> tuple[Array, Array, Array]:
    """Draw channels (r, n, c) in units of their noise, loads (r, n, m) and states (r, n, N) of so many records."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((records, len(prior))) @ _root(prior).T
    states = np.empty((records, len(models), len(prior)))
    for k, model in enumerate(models):
        states[:, k] = x
        x = x @ model.F.T + rng.standard_normal(x.shape) @ _root(model.Q).T
    y = states @ models[0].H.T
    return y + rng.standard_normal(y.shape), states @ models[0].U.T, states


def _root(covariance: Array) -> Array:
    value, vector = np.linalg.eigh(covariance)
    return vector * np.sqrt(np.maximum(value, 0.0))


@dataclass(frozen=True)
class ExactEstimates:
    """Loads and their variances (n, m), filtered and smoothed."""

    filtered: Array
    filtered_variance: Array
    smoothed: Array
    smoothed_variance: Array


def exact_estimates(models: Sequence[SampledModel], prior: Array, y: Array) -> ExactEstimates:
    """Run the Kalman filter with its covariance recursion and the Rauch-Tung-Striebel smoother, sample by sample."""
    x, P = np.zeros(len(prior)), prior
    before, after = [], []
    for model, sample in zip(models, y, strict=True):
        before.append((x, P))
        S = model.H @ P @ model.H.T + np.eye(len(model.H))
        gain = np.linalg.solve(S, model.H @ P).T
        x, P = x + gain @ (sample - model.H @ x), P - gain @ S @ gain.T
        after.append((x, P))
        x, P = model.F @ x, model.F @ P @ model.F.T + model.Q
    smooth = [after[-1]]
    for k in range(len(y) - 2, -1, -1):
        (x, P), (predicted, P_predicted), (smoothed, P_smoothed) = after[k], before[k + 1], smooth[-1]
        # The stored output of a delayed channel equals an earlier state, so that the predicted covariance is singular.
        gain = P @ models[k].F.T @ np.linalg.pinv(P_predicted, rcond=1e-13, hermitian=True)
        smooth.append((x + gain @ (smoothed - predicted), P + gain @ (P_smoothed - P_predicted) @ gain.T))
    U = models[0].U
    return ExactEstimates(*_loads(after, U), *_loads(smooth[::-1], U))


def _loads(estimates: Sequence[tuple[Array, Array]], U: Array) -> tuple[Array, Array]:
    return np.array([U @ x for x, _ in estimates]), np.array([np.diag(U @ P @ U.T) for _, P in estimates])
