"""Load models: their matrices against the spectra and sizes that they state, and how oscillators turn."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_lyapunov

from balance_cli.reduction.kalman.load_models import (
    BandLimitedNoise,
    FirstOrderMarkov,
    LowPassDrift,
    Oscillators,
    combine_layers,
)
from tests.support.kalman_models import Array

SIGMA = np.array([2.0, 0.5, 30.0])
LAYERS = {
    "wandering": LowPassDrift(SIGMA, 0.3, 5.0),
    "fluctuating": LowPassDrift(SIGMA, 50.0, 80.0),
    "flat": BandLimitedNoise(SIGMA, 40.0),
    "gust": FirstOrderMarkov(SIGMA, 25.0),
}


def _density(matrices: tuple[Array, Array, Array], frequency: Array) -> Array:
    """Densities (k, m) of U x, |U (j w - A)^-1 ...|^2."""
    A, W, U = matrices
    away = 2j * np.pi * frequency[:, None, None] * np.eye(len(A)) - A
    G = U @ np.linalg.inv(away)
    return np.einsum("kia,ab,kib->ki", G, W, G.conj()).real


@pytest.mark.parametrize("layer", LAYERS.values(), ids=LAYERS.keys())
def test_spectrum_is_that_of_the_matrices(layer):
    frequency = np.concatenate([[0.0], np.geomspace(1e-3, 1e3, 60)])
    assert np.allclose(layer.spectrum(frequency), _density(layer.matrices(), frequency), rtol=1e-10, atol=0)


@pytest.mark.parametrize("layer", LAYERS.values(), ids=LAYERS.keys())
def test_loads_are_as_large_as_stated(layer):
    A, W, U = layer.matrices()
    covariance = U @ solve_continuous_lyapunov(A, -W) @ U.T
    assert np.allclose(covariance, np.diag(layer.sigma**2), rtol=1e-10, atol=1e-10)


def test_flat_loads_are_flat_up_to_their_band():
    density = BandLimitedNoise(SIGMA, 40.0).spectrum(np.array([0.0, 10.0, 40.0, 400.0]))[:, 0]
    assert density[1] > 0.99 * density[0]
    assert np.isclose(density[2], 0.5 * density[0], rtol=1e-12)
    assert density[3] < 2e-4 * density[0]


ORDERS = (1, 2, 5)
OSCILLATORS = Oscillators(np.full((3, 2), 0.1), np.array([[1.0, 4.0], [2.0, 5.0], [3.0, 6.0]]), ORDERS, speed=7.0)


def test_oscillators_give_harmonics_of_the_azimuth():
    """From (alpha, beta) at azimuth 0 on p = alpha cos n psi + beta sin n psi, and the load is the sum of all p."""
    A, _, U = OSCILLATORS.matrices()
    rng = np.random.default_rng(0)
    alpha, beta = rng.standard_normal((2, 2, 3))
    start = np.stack([alpha, beta], axis=2).ravel()
    for time in (0.0, 0.013, 0.4):
        angle = np.array(ORDERS) * 2 * np.pi * 7.0 * time
        load = np.sum(alpha * np.cos(angle) + beta * np.sin(angle), axis=1)
        assert np.allclose(U @ expm(A * time) @ start, load, rtol=0, atol=1e-9)


def test_pairs_turn_backwards_as_one_complex_number():
    """p + j q is multiplied by exp(-j n psi), as the filter that follows the azimuth takes it."""
    A, _, _ = OSCILLATORS.matrices()
    start = np.random.default_rng(1).standard_normal(len(A))
    z = start[::2] + 1j * start[1::2]
    moved = expm(A * 0.02) @ start
    turned = z * np.exp(-2j * np.pi * 7.0 * 0.02 * np.tile(ORDERS, 2))
    assert np.allclose(moved[::2] + 1j * moved[1::2], turned, rtol=0, atol=1e-10)


def test_oscillators_drift_alike_in_cosine_and_sine():
    _, W, _ = OSCILLATORS.matrices()
    assert np.allclose(W, 0.01 * np.eye(12), rtol=1e-12, atol=0)


def test_stationary_oscillators_keep_their_size():
    A, W, U = OSCILLATORS.with_stationary_drift().matrices()
    covariance = solve_continuous_lyapunov(A, -W)
    assert np.allclose(np.diag(covariance), np.repeat(OSCILLATORS.size.T.ravel() ** 2, 2), rtol=1e-9)
    assert np.allclose(np.diag(U @ covariance @ U.T), OSCILLATORS.sigma**2, rtol=1e-9)


def test_layers_together_are_the_sum_of_their_loads():
    first, second = LowPassDrift(SIGMA, 0.3, 5.0), BandLimitedNoise(SIGMA, 40.0)
    frequency = np.geomspace(0.01, 100.0, 20)
    both = _density(combine_layers([first, second]), frequency)
    assert np.allclose(both, first.spectrum(frequency) + second.spectrum(frequency), rtol=1e-9, atol=0)
