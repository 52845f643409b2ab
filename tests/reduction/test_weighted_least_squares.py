"""Loads from channel amplitudes: weights, covariance, distribution of the residual test."""

import numpy as np
import pytest
from scipy import stats

from balance_cli.reduction.response_sources import circular_real, stacked_real
from balance_cli.reduction.weighted_least_squares import solve_loads


def problem(rng, harmonics=1, channels=9, loads=6):
    T = rng.standard_normal((harmonics, channels, loads)) + 1j * rng.standard_normal((harmonics, channels, loads))
    root = np.diag(rng.uniform(0.5, 2.0, channels)) @ (
        np.eye(channels) + 0.3 * rng.standard_normal((channels, channels))
    )
    f = rng.standard_normal((harmonics, loads)) + 1j * rng.standard_normal((harmonics, loads))
    return T, root, f


def draw(rng, T, root, f):
    noise = rng.standard_normal((2, len(T), len(root))) / np.sqrt(2)
    y = np.einsum("hab,hb->ha", T, f) + (noise[0] + 1j * noise[1]) @ root.T
    return np.concatenate([y.real, y.imag], axis=1)


def no_error(loads):
    return np.zeros((len(loads), 18, 18))


def test_loads_and_covariance_are_those_of_weighted_least_squares():
    rng = np.random.default_rng(0)
    T, root, f = problem(rng, harmonics=4000)
    T, f = np.repeat(T[:1], 4000, axis=0), np.repeat(f[:1], 4000, axis=0)
    noise = circular_real(np.broadcast_to((root @ root.T).astype(complex), (4000, 9, 9)))
    found = solve_loads(stacked_real(T), draw(rng, T, root, f), noise, np.full(4000, np.inf), no_error, np.ones(12))
    error = np.concatenate([(found.loads - f).real, (found.loads - f).imag], axis=1)
    scatter = np.cov(error.T)
    np.testing.assert_allclose(error.mean(axis=0), 0.0, atol=5 * np.sqrt(np.diag(scatter).max() / 4000))
    np.testing.assert_allclose(scatter, found.covariance[0], atol=0.12 * np.diag(scatter).max())
    assert np.mean(found.redundancy_chi2) == pytest.approx(1.0, abs=0.03)
    assert np.mean(found.misfit) == pytest.approx(0.001, abs=0.002)
    np.testing.assert_allclose(found.limit, stats.chi2.ppf(0.999, 6) / 6, rtol=1e-6)


def test_noise_that_was_estimated_does_not_raise_false_alarms():
    rng = np.random.default_rng(1)
    T, root, f = problem(rng, harmonics=3000)
    dof = 38
    draws = rng.standard_normal((2, 3000, dof, 9)) / np.sqrt(2)
    samples = (draws[0] + 1j * draws[1]) @ root.T
    estimated = np.einsum("hdi,hdj->hij", samples, samples.conj()) / dof
    y = draw(rng, T, root, f)
    found = solve_loads(stacked_real(T), y, circular_real(estimated), np.full(3000, float(dof)), no_error, np.ones(12))
    assert np.mean(found.redundancy_chi2) == pytest.approx(1.0, abs=0.04)
    assert np.mean(found.misfit) == pytest.approx(0.001, abs=0.002)
    error = (found.loads - f).real / np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2)[:, :6])
    assert np.std(error) == pytest.approx(1.0, abs=0.05)


def test_noise_of_fewer_degrees_of_freedom_than_redundant_equations_is_tested_by_its_variances():
    rng = np.random.default_rng(7)
    h, dof, sigma = 1000, 17, rng.uniform(0.5, 2.0, 25)

    def noise(*shape):
        parts = rng.standard_normal((2, *shape, 25)) / np.sqrt(2) * sigma
        return parts[0] + 1j * parts[1]

    T = rng.standard_normal((h, 25, 6)) + 1j * rng.standard_normal((h, 25, 6))
    samples = noise(h, dof)
    estimated = circular_real(np.einsum("hdi,hdj->hij", samples, samples.conj()) / dof)
    y = T.sum(axis=2) + noise(h)
    y = np.concatenate([y.real, y.imag], axis=1)

    def solve(y):
        weights = np.broadcast_to(np.diag(np.tile(sigma**2, 2)), (h, 50, 50))
        dofs = np.full(h, float(dof))
        return solve_loads(stacked_real(T), y, estimated, dofs, lambda loads: 0.0 * estimated, np.ones(12), weights)

    found = solve(y)
    assert np.mean(found.redundancy_chi2) == pytest.approx(1.0, abs=0.05)
    assert np.mean(found.misfit) < 0.003
    found = solve(y + 10.0 * np.tile(sigma, 2) * (np.arange(50) % 25 == 3))
    assert np.mean(found.misfit) > 0.95


@pytest.mark.parametrize("knows_shape", [True, False])
@pytest.mark.parametrize("dof", [3, 8, 14])
def test_loads_that_fluctuate_do_not_hide_an_error_of_a_channel(dof, knows_shape):
    """In 80 revolutions of a turbulent record chi-square had been 1e-5 of that of noise, and crosstalk unseen."""
    rng = np.random.default_rng(dof)
    h, channels, loads, sigma = 2000, 17, 6, rng.uniform(0.7, 1.4, 17)
    T, _, f = problem(rng, harmonics=h, channels=channels)

    def noise(*shape):
        parts = rng.standard_normal((2, *shape, channels)) / np.sqrt(2) * sigma
        return parts[0] + 1j * parts[1]

    gusts = 100.0 * (rng.standard_normal((2, h, dof, loads)))
    samples = noise(h, dof) + np.einsum("hab,hdb->hda", T, gusts[0] + 1j * gusts[1])
    estimated = circular_real(np.einsum("hdi,hdj->hij", samples, samples.conj()) / dof)
    weights = np.broadcast_to(np.diag(np.tile(sigma**2, 2)), (h, 34, 34)) if knows_shape else None

    def misfit(error):
        y = np.einsum("hab,hb->ha", T, f) + noise(h) + error
        both, dofs = np.concatenate([y.real, y.imag], axis=1), np.full(h, float(dof))
        zero = lambda f: np.zeros((h, 34, 34))  # noqa: E731
        return solve_loads(stacked_real(T), both, estimated, dofs, zero, np.ones(12), weights)

    sound = misfit(0.0)
    assert np.mean(sound.misfit) < 0.003
    if knows_shape:
        # Few lines show too few directions, and the factor for a scale that was estimated is too low.
        assert 0.87 < np.mean(sound.redundancy_chi2) < 1.05
    assert np.mean(misfit(30.0 * (np.arange(channels) == 3)).misfit) > (0.95 if knows_shape else 0.8)


def test_loads_of_many_channels_and_few_lines_of_noise_have_honest_sigmas():
    """25 channels and 17 lines: their covariance has no inverse, and the weights rest on its variances."""
    rng, draws = np.random.default_rng(2), 600
    T, root, f = problem(rng, channels=25)
    T, f = np.repeat(T, draws, axis=0), np.repeat(f, draws, axis=0)
    lines = (rng.standard_normal((draws, 17, 25)) + 1j * rng.standard_normal((draws, 17, 25))) / np.sqrt(2) @ root.T
    noise = circular_real(np.einsum("dka,dkb->dab", lines, lines.conj()) / 17)
    dof, scale = np.full(draws, 17.0), np.ones(12)
    found = solve_loads(
        stacked_real(T), draw(rng, T, root, f), noise, dof, lambda loads: np.zeros((draws, 50, 50)), scale
    )
    error = np.concatenate([(found.loads - f).real, (found.loads - f).imag], axis=1)
    sigma = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    assert np.mean(np.abs(error) < 1.96 * sigma) == pytest.approx(0.95, abs=0.035)
    assert np.mean(found.misfit) < 0.01


def test_a_wrong_response_is_found_out_and_widens_sigma():
    rng = np.random.default_rng(2)
    T, root, f = problem(rng, harmonics=50)
    noise = circular_real(np.broadcast_to((root @ root.T).astype(complex), (50, 9, 9)))
    y = draw(rng, T, root, 30.0 * f)
    wrong = T * (1 + 0.2 * rng.standard_normal(T.shape))
    found = solve_loads(stacked_real(wrong), y, noise, np.full(50, np.inf), no_error, np.ones(12))
    assert np.mean(found.misfit) > 0.9
    ratio = found.inflated_covariance[found.misfit] / found.covariance[found.misfit]
    np.testing.assert_allclose(ratio[:, 0, 0], found.redundancy_chi2[found.misfit])


def test_the_error_of_the_response_reaches_sigma():
    rng = np.random.default_rng(3)
    T, root, f = problem(rng, harmonics=2000)
    T, f = np.repeat(T[:1], 2000, axis=0), np.repeat(f[:1], 2000, axis=0)
    noise = circular_real(np.broadcast_to((root @ root.T).astype(complex), (2000, 9, 9))) * 1e-4
    relative = 0.02
    draws = rng.standard_normal((2, *T.shape)) / np.sqrt(2)
    true = T * (1 + relative * (draws[0] + 1j * draws[1]))

    def response_covariance(loads):
        size = np.abs(T) ** 2 @ np.abs(loads[:, :6] + 1j * loads[:, 6:])[:, :, None] ** 2
        each = 0.5 * relative**2 * size[:, :, 0]
        return np.einsum("ha,ab->hab", np.concatenate([each, each], axis=1), np.eye(18))

    y = draw(rng, true, 1e-2 * root, f)
    found = solve_loads(stacked_real(T), y, noise, np.full(2000, np.inf), response_covariance, np.ones(12))
    scatter = np.var((found.loads - f).real, axis=0)
    np.testing.assert_allclose(scatter, np.diagonal(found.covariance[0])[:6], rtol=0.2)
    assert np.mean(found.redundancy_chi2) == pytest.approx(1.0, abs=0.1)


def test_condition_counts_channels_in_units_of_their_noise():
    T = np.diag([1.0, 1.0, 4.0])[None]
    noise = np.diag([1.0, 1.0, 4.0])[None]
    found = solve_loads(
        T[:, :, :2], np.ones((1, 3)), noise, np.array([np.inf]), lambda f: np.zeros((1, 3, 3)), np.ones(2)
    )
    assert found.condition[0] == pytest.approx(1.0)


def test_condition_is_the_same_in_every_unit_of_the_moments():
    rng = np.random.default_rng(3)
    T, noise = rng.standard_normal((1, 4, 2)), np.eye(4)[None]

    def condition(T, scale):
        return solve_loads(
            T, np.ones((1, 4)), noise, np.array([np.inf]), lambda f: np.zeros((1, 4, 4)), scale
        ).condition

    in_millimeters = np.array([1.0, 1e-3])
    assert condition(T * in_millimeters, in_millimeters) == pytest.approx(condition(T, np.ones(2)))


def test_noise_of_fewer_lines_than_channels_tests_the_redundant_direction():
    """The covariance is singular there, as that of nine channels from three lines; it had rejected every record."""
    rng = np.random.default_rng(11)
    h, dof = 2000, 3
    T, root, f = problem(rng, harmonics=h, channels=7)
    draws = rng.standard_normal((2, h, dof, 7)) / np.sqrt(2)
    samples = (draws[0] + 1j * draws[1]) @ root.T
    estimated = circular_real(np.einsum("hdi,hdj->hij", samples, samples.conj()) / dof)
    weights = np.broadcast_to(np.eye(14), (h, 14, 14))
    known = np.full(h, float(dof))
    y = draw(rng, T, root, f)
    found = solve_loads(stacked_real(T), y, estimated, known, lambda loads: 0.0 * estimated, np.ones(12), weights)
    assert np.all(found.redundancy_chi2 >= 0.0)
    assert np.mean(found.misfit) == pytest.approx(0.001, abs=0.002)
    assert np.mean(found.redundancy_chi2) == pytest.approx(1.0, abs=0.15)
