"""Steady covariances and sums along a recursion against scipy's Riccati solver and sums term by term."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import block_diag, solve_discrete_are

from balance_cli.reduction.kalman.riccati import discrete_gramian, steady_covariance
from tests.support.kalman_models import Array


def _rotation(turn: float, decay: float = 1.0) -> Array:
    c, s = decay * np.cos(turn), decay * np.sin(turn)
    return np.array([[c, s], [-s, c]])


def _system(F: Array, seed: int, noise: int, channels: int = 2) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((len(F), noise))
    return F, root @ root.T, rng.standard_normal((channels, len(F)))


def _random(seed: int, radius: float) -> Array:
    F = np.random.default_rng(100 + seed).standard_normal((6, 6))
    return F * radius / np.abs(np.linalg.eigvals(F)).max()


SYSTEMS = {
    **{f"random {seed}": _system(_random(seed, 0.97), seed, 6) for seed in range(4)},
    "unstable": _system(_random(4, 1.3), 4, 6),
    "lightly damped": _system(block_diag(_rotation(0.3, 1 - 1e-6), _rotation(1.1, 0.999), 0.99), 5, 3),
    "on the unit circle": _system(block_diag(_rotation(0.4), _rotation(0.8), 1.0), 6, 5),
    "on the unit circle, hardly drifting": (
        block_diag(_rotation(0.4), 0.9),
        np.diag([1e-10, 1e-10, 1.0]),
        np.array([[1.0, 0.0, 1.0]]),
    ),
}


@pytest.mark.parametrize("system", SYSTEMS.values(), ids=SYSTEMS.keys())
def test_steady_covariance_solves_the_riccati_equation(system):
    F, Q, H = system
    P = steady_covariance(F, Q, H)
    exact = solve_discrete_are(F.T, H.T, Q, np.eye(len(H)))
    assert np.abs(P - exact).max() < 1e-7 * np.abs(exact).max()
    assert np.array_equal(P, P.T)
    update = F @ (P - P @ H.T @ np.linalg.solve(H @ P @ H.T + np.eye(len(H)), H @ P)) @ F.T + Q
    assert np.abs(update - P).max() < 1e-10 * np.abs(P).max()


@pytest.mark.parametrize("system", SYSTEMS.values(), ids=SYSTEMS.keys())
def test_the_filter_at_its_steady_gain_is_stable(system):
    F, Q, H = system
    P = steady_covariance(F, Q, H)
    L = F - F @ P @ H.T @ np.linalg.solve(H @ P @ H.T + np.eye(len(H)), H)
    assert np.abs(np.linalg.eigvals(L)).max() < 1.0


@pytest.mark.parametrize("unobservable", [1.0, 1.1, 3.0])
def test_a_growing_unobservable_state_has_no_steady_covariance(unobservable):
    with pytest.raises(np.linalg.LinAlgError, match="no steady solution"):
        steady_covariance(np.diag([0.5, unobservable]), np.eye(2), np.array([[1.0, 0.0]]))


def test_what_decays_unobservable_has_one():
    P = steady_covariance(np.diag([0.5, 0.9]), np.eye(2), np.array([[1.0, 0.0]]))
    assert np.isclose(P[1, 1], 1.0 / (1.0 - 0.81), rtol=1e-10)


@pytest.mark.parametrize("steps", [0, 1, 2, 3, 7, 8, 100, 333])
def test_a_finite_sum_is_that_of_its_terms(steps):
    L, W, _ = _system(_random(7, 0.99), 7, 3)
    terms = [np.linalg.matrix_power(L, j) for j in range(steps)]
    exact = sum((power.T @ W @ power for power in terms), np.zeros_like(W))
    assert np.abs(discrete_gramian(L, W, steps) - exact).max() <= 1e-11 * np.abs(exact).max()


@pytest.mark.parametrize("radius", [0.5, 0.999])
def test_an_endless_sum_is_that_of_many_terms(radius):
    L, W, _ = _system(_random(8, radius), 8, 3)
    power, exact = np.eye(len(L)), np.zeros_like(W)
    for _ in range(int(40.0 / (1.0 - radius))):
        exact += power.T @ W @ power
        power = power @ L
    assert np.abs(discrete_gramian(L, W) - exact).max() < 1e-10 * np.abs(exact).max()


def test_an_endless_sum_reaches_through_a_chain_of_delays():
    """A chain passes its first place's noise on to every place, however little each step adds elsewhere."""
    L = np.eye(5, k=1)
    W = np.diag([1.0, 0.0, 0.0, 0.0, 0.0])
    assert np.array_equal(discrete_gramian(L, W), np.eye(5))
