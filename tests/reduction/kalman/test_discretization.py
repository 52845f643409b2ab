"""Steps of a continuous model, and outputs late by any time, against closed forms and the continuous covariances."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import expm, solve_continuous_lyapunov

from balance_cli.reduction.kalman.discretization import ContinuousModel, discretize, discretize_step
from balance_cli.reduction.kalman.riccati import discrete_gramian
from tests.support.kalman_models import Array

STEP = 0.01


def _stable(order: int, seed: int, size: float = 40.0) -> tuple[Array, Array]:
    """A stable A and an intensity W of full rank."""
    rng = np.random.default_rng(seed)
    A = size * rng.standard_normal((order, order))
    A -= (np.linalg.eigvals(A).real.max() + 0.2 * size) * np.eye(order)
    root = rng.standard_normal((order, order))
    return A, root @ root.T


@pytest.mark.parametrize("time", [1e-6, 0.01, 0.3])
def test_a_step_is_van_loans_matrix_exponential(time):
    A, W = _stable(5, 1, 8.0)
    n = len(A)
    block = expm(np.block([[-A, W], [np.zeros((n, n)), A.T]]) * time)
    Phi, Q = discretize_step(A, W, time)
    exact = block[n:, n:].T @ block[:n, n:]
    assert np.abs(Phi - block[n:, n:].T).max() < 1e-11
    assert np.abs(Q - exact).max() < 1e-10 * np.abs(exact).max()


def test_the_noise_of_a_step_is_the_integral_over_it():
    A, W = _stable(4, 2)
    Q = discretize_step(A, W, 0.02)[1]
    exact = quad_vec(lambda s: expm(A * s) @ W @ expm(A * s).T, 0.0, 0.02, epsrel=1e-12)[0]
    assert np.abs(Q - exact).max() < 1e-11 * np.abs(exact).max()


@pytest.mark.parametrize("time", [1e-7, 1e-3, 10.0])
def test_a_stiff_step_is_that_of_its_decays(time):
    """Poles from 1 to 1e6 per second: with eigenvectors V, Q = V (W_ij (exp((a_i + a_j) t) - 1) / (a_i + a_j)) V'."""
    rng = np.random.default_rng(3)
    rates = -np.array([1.0, 30.0, 2e3, 1e6])
    V = np.linalg.qr(rng.standard_normal((4, 4)))[0] @ np.diag([1.0, 2.0, 0.5, 1.5])
    root = rng.standard_normal((4, 4))
    sums = rates[:, None] + rates
    Phi, Q = discretize_step(V @ np.diag(rates) @ np.linalg.inv(V), V @ root @ root.T @ V.T, time)
    exact = V @ (root @ root.T * np.expm1(sums * time) / sums) @ V.T
    assert np.abs(Phi - V @ np.diag(np.exp(rates * time)) @ np.linalg.inv(V)).max() < 1e-9
    assert np.abs(Q - exact).max() < 1e-9 * np.abs(exact).max()


def test_a_step_without_dynamics_only_gathers_noise():
    Phi, Q = discretize_step(np.zeros((2, 2)), np.diag([1.0, 3.0]), 0.5)
    assert np.allclose(Phi, np.eye(2), rtol=0, atol=1e-15)
    assert np.allclose(Q, np.diag([0.5, 1.5]), rtol=0, atol=1e-15)


def _continuous_covariance(model: ContinuousModel, rows: Array, late: Array, lag: int) -> Array:
    """E[v_i(t + lag T) y_j(t)], v_i = rows_i x(t - late_i): states apart by lag T - late_i + delay_j."""
    P = solve_continuous_lyapunov(model.A, -model.W)
    found = np.empty((len(rows), len(model.C)))
    for i, row in enumerate(rows):
        for j, column in enumerate(model.C):
            apart = lag * STEP - late[i] + model.delay[j]
            between = expm(model.A * apart) @ P if apart >= 0 else P @ expm(-model.A * apart).T
            found[i, j] = row @ between @ column
    return found


DELAYS = {
    "none": (0.0, 0.0, 0.0),
    "a part of a sample": (0.0, 0.3, 0.0),
    "the same part": (0.4, 0.4, 0.0),
    "several parts": (0.85, 0.3, 0.31),
    "more than a sample": (2.3, 0.0, 1.3),
    "whole samples": (1.0, 3.0, 0.0),
    "whole samples and parts": (2.0, 2.7, 0.05),
    "a part next to a whole sample": (0.999999, 1.0, 1.000001),
}


@pytest.mark.parametrize("delays", DELAYS.values(), ids=DELAYS.keys())
def test_late_outputs_have_the_covariances_of_the_continuous_model(delays):
    A, W = _stable(4, 5)
    rng = np.random.default_rng(6)
    model = ContinuousModel(A, W, rng.standard_normal((3, 4)), np.array(delays) * STEP, rng.standard_normal((2, 4)))
    one = discretize(model, STEP)
    X = discrete_gramian(one.F.T, one.Q)
    F, size = np.eye(one.order), np.abs(_continuous_covariance(model, model.C, model.delay, 0)).max()
    for lag in range(6):
        outputs = _continuous_covariance(model, model.C, model.delay, lag)
        loads = _continuous_covariance(model, model.U, np.zeros(2), lag)
        assert np.abs(one.H @ F @ X @ one.H.T - outputs).max() < 1e-9 * size
        assert np.abs(one.U @ F @ X @ one.H.T - loads).max() < 1e-9 * size
        F = F @ one.F


def test_no_state_is_kept_of_an_output_that_is_not_late():
    A, W = _stable(3, 7)
    model = ContinuousModel(A, W, np.eye(3), np.array([0.0, 1.5, 2.0]) * STEP, np.eye(3))
    assert discretize(model, STEP).order == 3 + 2 + 2


@pytest.mark.parametrize("place", [0, 1])
def test_a_delay_of_rounding_alone_is_none(place):
    A, W = _stable(2, 8)
    delay = np.full(2, 0.5 * STEP)
    delay[place] = 0.0
    plain = discretize(ContinuousModel(A, W, np.eye(2), delay, np.eye(2)), STEP)
    delay[place] = 1e-18
    rounded = discretize(ContinuousModel(A, W, np.eye(2), delay, np.eye(2)), STEP)
    assert np.array_equal(plain.F, rounded.F)
    assert np.array_equal(plain.Q, rounded.Q)
    assert np.array_equal(plain.H, rounded.H)


def test_scaled_states_leave_the_channels_as_they_are():
    A, W = _stable(3, 9)
    model = discretize(ContinuousModel(A, W, np.eye(3), np.array([0.0, 0.3, 1.2]) * STEP, np.eye(3)), STEP)
    size = np.geomspace(1e-3, 1e3, model.order)
    scaled = model.scaled(size)
    for lag in range(3):
        one = model.H @ np.linalg.matrix_power(model.F, lag) @ model.Q @ model.H.T
        other = scaled.H @ np.linalg.matrix_power(scaled.F, lag) @ scaled.Q @ scaled.H.T
        assert np.abs(one - other).max() < 1e-10 * np.abs(model.Q).max()
