"""Loads from readings: the iteration, the proof that it converges, and the interval of what it finds."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.calibration.convergence import EXTRAPOLATION_MARGIN, contraction, iterate_loads
from balance_cli.calibration.fit import fit_calibration_model
from balance_cli.calibration.math_model import CalibrationModel, weighted_inverse
from balance_cli.calibration.noise import estimate_calibration_noise
from balance_cli.calibration.terms import Term, term_from_name, term_values
from balance_cli.campaign.rig.components import COMPONENTS
from tests.support.calibration_stand import FULL_RANGE, NOISE, stand_loads, stand_points, true_model


@pytest.fixture(scope="module")
def model() -> CalibrationModel:
    return fit_calibration_model(stand_points()).model


def random_loads(rows, reach=1.0, seed=7):
    return np.random.default_rng(seed).uniform(-reach, reach, (rows, 6)) * FULL_RANGE


# ---- the model -------------------------------------------------------------------------------------------------------


def test_loads_of_the_readings_of_loads_are_the_loads(model):
    applied = np.vstack([np.zeros(6), random_loads(200)])
    found, solved = model.loads(model.readings(applied))
    assert model.is_nonlinear and solved.all()
    np.testing.assert_allclose(found / FULL_RANGE, applied / FULL_RANGE, atol=1e-9)


def test_loads_beyond_the_reach_of_the_proof_are_flagged(model):
    reach = model.contraction().reach
    outside = np.diag(1.05 * reach * FULL_RANGE)
    assert not model.loads(model.readings(outside))[1].any()
    assert model.loads(model.readings(np.diag(FULL_RANGE)))[1].all()
    assert model.extrapolated_components(1.01 * FULL_RANGE) == COMPONENTS
    assert model.extrapolated_components(0.99 * FULL_RANGE) == ()


def test_loads_from_six_of_the_channels(model):
    rows = np.array([0, 1, 2, 3, 4, 5])
    applied = random_loads(20, 0.5)
    found, _ = model.loads(model.readings(applied)[:, rows], rows)
    np.testing.assert_allclose(found / FULL_RANGE, applied / FULL_RANGE, atol=1e-9)


def test_the_weighted_inverse_is_that_of_least_variance():
    rng = np.random.default_rng(0)
    C, half = rng.normal(size=(8, 6)), rng.normal(size=(8, 8))
    S = half @ half.T + np.eye(8)
    W = weighted_inverse(C, S)
    np.testing.assert_allclose(W @ C, np.eye(6), atol=1e-10)
    least = np.diag(W @ S @ W.T)
    # Any other left inverse differs by rows that C does not see.
    blind = np.eye(8) - C @ np.linalg.pinv(C)
    for _ in range(20):
        other = W + 0.1 * rng.normal(size=(6, 8)) @ blind
        np.testing.assert_allclose(other @ C, np.eye(6), atol=1e-9)
        assert np.all(np.diag(other @ S @ other.T) >= least - 1e-12)


def test_readings_are_those_of_the_true_balance(model):
    terms, b = true_model()
    applied = random_loads(50)
    np.testing.assert_allclose(model.readings(applied), term_values(terms, applied / FULL_RANGE) @ b, atol=5 * NOISE)


def test_the_interval_holds_95_percent_of_found_loads(model):
    """New readings of many loads by calibrations with new noise: every interval has its own model."""
    terms, b = true_model()
    rng = np.random.default_rng(3)
    hits = []
    for seed in range(6):
        one = fit_calibration_model(stand_points(seed)).model
        applied = random_loads(150, seed=100 + seed)
        read = term_values(terms, applied / FULL_RANGE) @ b + NOISE * rng.normal(size=(150, 8))
        found, solved = one.loads(read)
        assert solved.all()
        hits.append(np.abs(found - applied) <= one.interval(found))
    assert 0.93 < np.mean(hits) < 0.97
    assert np.all(np.abs(np.mean(np.concatenate(hits), axis=0) - 0.95) < 0.03)


def test_the_covariance_of_loads_is_that_of_the_tangent(model):
    """By drawing readings and coefficients, not by the formula."""
    rng = np.random.default_rng(1)
    applied = 0.7 * FULL_RANGE * np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0])
    sigma = NOISE * np.arange(1, 9)
    stated = replace(model, residual_covariance=np.diag(sigma**2))
    X = term_values(model.parsed_terms, applied[None] / FULL_RANGE)[0]
    # As much of the model's own error as of the readings' noise.
    stated = replace(stated, covariance=100.0 * model.covariance)
    shifts = [rng.multivariate_normal(np.zeros(len(X)), one, 4000) @ X for one in stated.covariance]
    read = model.readings(applied[None]) + np.column_stack(shifts) + sigma * rng.normal(size=(4000, 8))
    found = np.cov(stated.loads(read)[0].T)
    expected = stated.load_covariance(applied)[0]
    np.testing.assert_allclose(np.sqrt(np.diag(found)), np.sqrt(np.diag(expected)), rtol=0.06)
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / scale[:, None] / scale, expected / scale[:, None] / scale, atol=0.08)


# ---- the proof -------------------------------------------------------------------------------------------------------


def test_without_curved_terms_nothing_is_iterated():
    proof = contraction(np.zeros((6, 0)), (), 6)
    assert proof.rho == 0.0 and proof.is_proved


@pytest.mark.parametrize("size", [0.05, 0.15, 0.3])
def test_every_step_shrinks_the_error_by_the_bound_at_least(size):
    """In the norm of the proof no step from any start within range is worse than rho, and rho is not idle."""
    terms = [term_from_name(name, ("F", "G")) for name in ("F^2", "|G^3|", "F |G|")]
    rng = np.random.default_rng(int(100 * size))
    worst = 0.0
    for _ in range(30):
        nonlinear_matrix = size * rng.uniform(-1.0, 1.0, (2, len(terms)))
        proof = contraction(nonlinear_matrix, terms, 2)
        if not proof.is_proved:
            continue
        x = rng.uniform(-EXTRAPOLATION_MARGIN, EXTRAPOLATION_MARGIN, (200, 2))
        straight = x + term_values(terms, x) @ nonlinear_matrix.T
        now = straight
        weights = perron(nonlinear_matrix, terms, proof.reach)
        error = np.max(np.abs(now - x) / weights, axis=1)
        for _ in range(6):
            assert np.all(np.abs(now) <= proof.reach + 1e-12)
            now = straight - term_values(terms, now) @ nonlinear_matrix.T
            after = np.max(np.abs(now - x) / weights, axis=1)
            assert np.all(after <= (proof.rho + 1e-6) * error + 1e-14)
            big = error > 1e-8
            if big.any():
                worst = max(worst, float(np.max(after[big] / error[big]) / proof.rho))
            error = after
        found, done = iterate_loads(straight, nonlinear_matrix, terms)
        assert done.all()
        np.testing.assert_allclose(found, x, atol=1e-10)
    assert worst > 0.3


def perron(nonlinear_matrix, terms, reach):
    """The weights of the norm, by power iteration on the bound of the derivative, from finite differences."""
    corner = np.asarray(reach)[None]
    step = 1e-7
    slope = np.stack(
        [
            (term_values(terms, corner + step * e) - term_values(terms, corner - step * e))[0] / (2 * step)
            for e in np.eye(2)
        ]
    )
    M = np.abs(nonlinear_matrix) @ np.abs(slope).T
    v = np.ones(2)
    for _ in range(2000):
        v = M @ v + 1e-9
        v /= v.max()
    return v


def test_nothing_is_proved_where_the_iteration_diverges():
    """r = x + 2 x^2: from a load of full range the iteration runs away."""
    terms = [Term(0, 3, 0)]
    assert terms[0].name("F") == "F^2"
    nonlinear_matrix = np.array([[2.0]])
    x = np.array([[1.0]])
    found, done = iterate_loads(x + term_values(terms, x) @ nonlinear_matrix.T, nonlinear_matrix, terms)
    assert not done.any() or abs(found[0, 0] - 1.0) > 0.1
    proof = contraction(nonlinear_matrix, terms, 1)
    assert not proof.is_proved and proof.rho == float("inf")


def test_the_proof_ends_before_the_slope_reaches_one():
    """One load: rho is |b| times the steepest slope within reach, and beyond 1 nothing is proved."""
    terms = [Term(0, 3, 0)]
    proof = contraction(np.array([[0.1]]), terms, 1)
    assert proof.rho == pytest.approx(0.2 * proof.reach[0], rel=1e-6)
    # The first error, b 1.1^2, widens the reach by as much.
    assert proof.reach[0] == pytest.approx(EXTRAPOLATION_MARGIN + 0.1 * EXTRAPOLATION_MARGIN**2, rel=1e-6)
    assert contraction(np.array([[0.3]]), terms, 1).is_proved
    assert not contraction(np.array([[0.45]]), terms, 1).is_proved


def test_the_proof_for_the_fitted_model(model):
    proof = model.contraction()
    assert proof.is_proved and np.all(proof.reach >= EXTRAPOLATION_MARGIN) and proof.rho > 0.01


# ---- noise -----------------------------------------------------------------------------------------------------------


def test_noise_of_readings_and_of_loads_are_told_apart():
    rng = np.random.default_rng(2)
    x, _ = stand_loads()
    _, b = true_model()
    C = b[:6].T
    own = NOISE * np.linspace(1.0, 2.0, 8)
    of_loads = np.array([0.0, 2e-3, 0.0, 1e-3, 0.0, 5e-4])
    stated, channels = [], []
    for _ in range(6):
        load_noise = np.where(np.abs(x) > 0, of_loads * rng.normal(size=x.shape), 0.0)
        residuals = own * rng.normal(size=(len(x), 8)) + load_noise @ C.T
        estimate = estimate_calibration_noise(residuals, x, C, np.cov(residuals.T))
        stated.append(estimate.load_sigma)
        channels.append(np.sqrt(np.diag(estimate.reading_covariance)))
    np.testing.assert_allclose(np.mean(stated, axis=0)[[1, 3]], of_loads[[1, 3]], rtol=0.1)
    assert np.all(np.mean(stated, axis=0)[[0, 2, 4]] < 4e-4)
    np.testing.assert_allclose(np.mean(channels, axis=0), own, rtol=0.15)


def test_loads_without_noise_get_none():
    rng = np.random.default_rng(6)
    x, _ = stand_loads()
    _, b = true_model()
    residuals = NOISE * rng.normal(size=(len(x), 8))
    estimate = estimate_calibration_noise(residuals, x, b[:6].T, np.cov(residuals.T))
    assert np.all(estimate.load_sigma < 0.5 * NOISE)
