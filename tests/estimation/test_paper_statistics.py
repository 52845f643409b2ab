"""The paper's form against statistics and numerical derivatives: gradient, Hessian, bias, covariance, chi-square."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.estimation.paper.equations import (
    Coefficients,
    coefficients_from_table,
    first_order_matrix,
    free_coefficients,
    is_stable,
    modes_of_coefficients,
    stabilize,
)
from balance_cli.estimation.paper.fit import identify_paper_form, response, response_jacobian
from balance_cli.estimation.paper.misfit import compare_with_measurement
from balance_cli.estimation.paper.output_error import (
    evaluate_model,
    exact_derivatives,
    gauss_newton_derivatives,
    group_by_frequency,
)
from balance_cli.estimation.paper.result import PaperOptions
from balance_cli.estimation.paper.sensors import sensor_rule
from balance_cli.estimation.paper.spectra import sensor_spectra
from tests.support.paper_truth import make_plate, sweep, sweeps
from tests.support.rigs import two_degrees_of_freedom

LINES = np.arange(20.0, 110.0, 0.5)
BAND = (20.0, 110.0)


def lopsided_bar():
    """Two freedoms, two unequal cells, hub off the centre: heave and pitch coupled, D not diagonal."""
    rig = two_degrees_of_freedom()
    soft = rig.cells[1].model_copy(update={"stiffness": 6e5})
    return make_plate(rig.model_copy(update={"cells": (rig.cells[0], soft), "hub": (0.1, 0.0, 0.5)}))


@pytest.fixture(scope="module")
def bar():
    return lopsided_bar()


def noisy(bar, seed, **more):
    return sweeps(bar, ("Fz", "My"), LINES, seed=seed, **{"force_noise": 0.05, **more})


def truth_of(bar, fit):
    return np.hstack(bar.coefficients(fit.rule.matrix, fit.inputs))


def derivative(function, at, step):
    """Central differences by each entry of `at`, with relative steps."""
    slopes = []
    for i, value in enumerate(at):
        h = step * max(abs(value), 1.0)
        e = np.zeros_like(at)
        e[i] = h
        slopes.append((function(at + e) - function(at - e)) / (2 * h))
    return np.stack(slopes, axis=-1)


@pytest.mark.parametrize("noise", ["full", "diagonal", "equal"])
@pytest.mark.parametrize("full_damping", [False, True])
def test_gradient_and_exact_hessian_against_differences(bar, noise, full_damping):
    spectra = sensor_spectra(bar.geometry, sensor_rule(bar.geometry), noisy(bar, 1))
    data = group_by_frequency(spectra)
    free = free_coefficients(2, 2, full_damping)
    table = np.hstack(bar.coefficients(np.eye(2), ("Fz", "My")))
    table[:, 2:4] *= 1.02  # away from the minimum, so that every term of the Hessian counts
    theta = table[free]

    def at(parameters):
        moved = table.copy()
        moved[free] = parameters
        return evaluate_model(data, coefficients_from_table(moved), noise)

    analytic = exact_derivatives(data, free, at(theta), noise)
    gradient = -0.5 * derivative(lambda t: np.array(at(t).cost), theta, 1e-6)
    np.testing.assert_allclose(analytic.gradient, gradient, rtol=1e-4, atol=1e-6 * np.abs(gradient).max())
    hessian = -derivative(lambda t: exact_derivatives(data, free, at(t), noise).gradient, theta, 1e-6)
    if noise == "equal":
        # The term left out there is the product of two gradients.
        n, g = 2, analytic.gradient
        hessian = hessian + np.outer(g, g) * 2 / (n * data.lines)
    scale = np.sqrt(np.abs(np.diag(hessian)))
    np.testing.assert_allclose(
        analytic.hessian / np.outer(scale, scale), hessian / np.outer(scale, scale), rtol=1e-4, atol=1e-4
    )


def test_gauss_newton_is_the_sum_over_an_explicit_jacobian(bar):
    runs = noisy(bar, 2)
    fit = identify_paper_form(bar.geometry, runs, PaperOptions("ls", "full", BAND))
    spectra = sensor_spectra(bar.geometry, fit.rule, runs)
    data = group_by_frequency(spectra)
    at = evaluate_model(data, fit.model, "full")
    J = np.einsum("kijp,kj->kip", response_jacobian(fit, spectra.frequency), spectra.u)
    weighted = np.linalg.solve(at.S, J)
    explicit = np.einsum("kip,kiq->pq", J.conj(), weighted).real
    np.testing.assert_allclose(gauss_newton_derivatives(data, fit.free, at).hessian, explicit, rtol=1e-9, atol=1e-9)


def test_response_jacobian_against_differences(bar):
    fit = identify_paper_form(bar.geometry, noisy(bar, 3), PaperOptions("ls", "diagonal", BAND))
    frequency = np.array([0.0, 17.5, 42.0, 75.0])

    def moved(parameters):
        table = fit.model.table
        table[fit.free] = parameters
        return response(replace(fit, model=coefficients_from_table(table)), frequency)

    numerical = derivative(moved, fit.parameters, 1e-6)
    analytic = response_jacobian(fit, frequency)
    assert analytic.shape == (4, 2, 2, 2 + 4 + 4)
    scale = np.abs(numerical).max(axis=(0, 1, 2))
    np.testing.assert_allclose(analytic / scale, numerical / scale, atol=1e-6)


def test_sigma_of_modes_against_differences(bar):
    fit = identify_paper_form(bar.geometry, noisy(bar, 4), PaperOptions(damping="full", band=BAND))

    def eigen(parameters):
        table = fit.model.table
        table[fit.free] = parameters
        values = np.linalg.eigvals(first_order_matrix(coefficients_from_table(table)))
        values = np.sort_complex(values[values.imag > 0])
        values = values[np.argsort(np.abs(values))]
        return np.concatenate([np.abs(values) / (2 * np.pi), -values.real / np.abs(values)])

    slope = derivative(eigen, fit.parameters, 1e-6)
    sigma = np.sqrt(np.einsum("mp,pq,mq->m", slope, fit.covariance, slope))
    result = [m.sigma_frequency_hz for m in fit.modes] + [m.sigma_damping_ratio for m in fit.modes]
    np.testing.assert_allclose(result, sigma, rtol=1e-4)


def test_real_eigenvalues_are_modes_of_their_own():
    # (lambda + 1)(lambda + 4) = lambda^2 + 5 lambda + 4
    model = Coefficients(np.array([[5.0]]), np.array([[4.0]]), np.array([[1.0]]))
    result = modes_of_coefficients(model, free_coefficients(1, 1, True), np.zeros((3, 3)))
    np.testing.assert_allclose([m.frequency_hz * 2 * np.pi for m in result], [1.0, 4.0])
    assert [m.damping_ratio for m in result] == [1.0, 1.0]


def test_noise_biases_least_squares_but_not_maximum_likelihood(bar):
    """Ten records: the mean error of every parameter in units of its standard error."""
    worst = {}
    for method in ("ls", "ls+ml"):
        fits = [
            identify_paper_form(bar.geometry, noisy(bar, seed, force_noise=0.5), PaperOptions(method, "full", BAND))
            for seed in range(10, 20)
        ]
        errors = np.array([fit.parameters - truth_of(bar, fit)[fit.free] for fit in fits])
        worst[method] = np.max(np.abs(errors.mean(axis=0)) / (errors.std(axis=0, ddof=1) / np.sqrt(len(fits))))
        damping = np.mean([[mode.damping_ratio for mode in fit.modes] for fit in fits], axis=0)
        worst[method, "damping"] = np.max(np.abs(damping - 0.02))
    assert worst["ls"] > 15.0
    assert worst["ls+ml"] < 5.0
    assert worst["ls", "damping"] > 10 * worst["ls+ml", "damping"]


def test_covariance_against_the_scatter_of_sixty_fits(bar):
    options = PaperOptions(damping="full", band=BAND)
    fits = [identify_paper_form(bar.geometry, noisy(bar, seed), options) for seed in range(100, 160)]
    assert all(fit.converged for fit in fits)
    p, count = len(fits[0].parameters), len(fits)
    errors = [fit.parameters - truth_of(bar, fit)[fit.free] for fit in fits]
    distance = [e @ np.linalg.solve(fit.covariance, e) for e, fit in zip(errors, fits, strict=True)]
    # Sum of chi-squares: mean p, variance 2p / count; four standard deviations.
    assert np.mean(distance) == pytest.approx(p, abs=4 * np.sqrt(2 * p / count))
    frequency = np.array([[m.frequency_hz for m in fit.modes] for fit in fits])
    sigma = np.array([[m.sigma_frequency_hz for m in fit.modes] for fit in fits])
    ratio = frequency.std(axis=0, ddof=1) / sigma.mean(axis=0)
    np.testing.assert_allclose(ratio, 1.0, atol=4 / np.sqrt(2 * count))
    chi2 = [fit.misfit.chi2_per_dof for fit in fits]
    assert np.mean(chi2) == pytest.approx(1.0, abs=4 * np.sqrt(2 / fits[0].misfit.dof / count))
    # S is the noise: 0.05^2 N2 in each cell.
    np.testing.assert_allclose(np.mean([fit.S for fit in fits], axis=0), 0.0025 * np.eye(2), atol=1e-4)


def test_covariance_of_least_squares_where_only_the_equation_is_noisy(bar):
    """White equation noise, the one case in which least squares is unbiased and its covariance holds."""
    rule = sensor_rule(bar.geometry)
    clean = sweeps(bar, ("Fz", "My"), LINES)
    D, K, B_F = bar.coefficients(rule.matrix, ("Fz", "My"))
    w = 2 * np.pi * LINES[:, None, None]
    R = np.linalg.inv(K - w**2 * np.eye(2) + 1j * w * D)
    sensitivity, distance = 0.002, []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        runs = []
        for line in clean:
            # Noise in the equation acts like a further input; a and b share part of it. Powers small enough that the
            # regressors stay exact to first order.
            e = rng.standard_normal((len(LINES), 2)) + 1j * rng.standard_normal((len(LINES), 2))
            e = e @ np.array([[1.0, 0.6], [0.0, 0.8]]) * 20.0
            runs.append(replace(line, channels=line.channels + sensitivity * (R @ e[:, :, None])[:, :, 0]))
        fit = identify_paper_form(bar.geometry, runs, PaperOptions("ls", "full", BAND))
        error = fit.parameters - np.hstack([D, K, B_F])[fit.free]
        distance.append(error @ np.linalg.solve(fit.covariance, error))
    p = len(error)
    assert np.mean(distance) == pytest.approx(p, abs=5 * np.sqrt(2 * p / 60))


def test_chi_square_counts_the_noise_of_the_loads(bar):
    """At the true model: 1 with the noise of both, far more where that of the loads is forgotten."""
    runs = noisy(bar, 5, force_noise=0.005, load_noise=0.02)
    blind = [replace(run, covariance=run.covariance * np.array([1, 1, 1e-9])[:, None]) for run in runs]
    chi2 = {}
    for name, lines in (("both", runs), ("forces only", blind)):
        spectra = sensor_spectra(bar.geometry, sensor_rule(bar.geometry), lines)
        true = Coefficients(*bar.coefficients(np.eye(2), spectra.inputs))
        result = compare_with_measurement(spectra, spectra, true, 0, (5.0, 150.0))
        chi2[name] = result.chi2_per_dof
        dof = result.dof
    assert dof == 2 * 2 * 2 * len(LINES)
    assert chi2["both"] == pytest.approx(1.0, abs=4 * np.sqrt(2 / dof))
    assert chi2["forces only"] > 20.0


def test_chi_square_allows_for_an_estimated_noise_covariance(bar):
    """A covariance from 12 degrees of freedom has an inverse that is 12 / (12 - n) too large on average."""
    rng = np.random.default_rng(3)
    runs, dof = noisy(bar, 8), 12
    estimated = []
    for run in runs:
        L = np.sqrt(run.covariance)
        shape = (len(LINES), 3, dof)
        z = L @ (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)
        estimated.append(replace(run, covariance=z @ z.conj().swapaxes(1, 2) / dof, dof=float(dof)))
    spectra = sensor_spectra(bar.geometry, sensor_rule(bar.geometry), estimated)
    true = Coefficients(*bar.coefficients(np.eye(2), spectra.inputs))
    assert compare_with_measurement(spectra, spectra, true, 0, (5.0, 150.0)).chi2_per_dof == pytest.approx(
        1.0, abs=0.15
    )


def test_unstable_models_are_reflected_with_their_vectors_kept():
    rng = np.random.default_rng(7)
    A = rng.standard_normal((3, 3))
    K = A @ A.T + 5 * np.eye(3)
    D = np.diag([0.3, -0.4, 0.1]) + 0.02 * rng.standard_normal((3, 3))
    bad = Coefficients(D, K, np.ones((3, 1)))
    assert not is_stable(bad)
    mended = stabilize(bad)
    assert mended is not None and is_stable(mended)
    before, after = (np.linalg.eigvals(first_order_matrix(model)) for model in (bad, mended))
    np.testing.assert_allclose(np.sort(after.imag), np.sort(before.imag), atol=1e-8)
    np.testing.assert_allclose(np.sort(after.real), np.sort(-np.abs(before.real)), atol=1e-8)


@pytest.mark.parametrize("seed", range(5))
def test_strong_noise_from_both_starts(bar, seed):
    """A quarter of the signal is noise: both starts end at one minimum, stable and within sigma of the truth."""
    runs = noisy(bar, 200 + seed, force_noise=1.5)
    fits = [identify_paper_form(bar.geometry, runs, PaperOptions(method, "full", BAND)) for method in ("ls+ml", "ml")]
    assert all(fit.converged and fit.stable for fit in fits)
    assert np.all(np.abs(fits[0].parameters - fits[1].parameters) < 0.01 * fits[0].sigma)
    error = np.abs(fits[0].parameters - truth_of(bar, fits[0])[fits[0].free])
    assert np.all(error < 5 * fits[0].sigma)


def test_runs_with_different_lines_and_levels_share_one_model(bar):
    runs = [
        sweep(bar, {"Fz": 2.0}, np.arange(20.0, 100.0, 0.7)),
        sweep(bar, {"My": 0.3}, np.arange(31.0, 110.0, 0.4), seed=1),
        sweep(bar, {"My": 1.0, "Fz": 1.0}, np.array([50.0, 60.0]), seed=2),
    ]
    fit = identify_paper_form(bar.geometry, runs, PaperOptions(damping="full", band=BAND))
    np.testing.assert_allclose(fit.model.table, truth_of(bar, fit), rtol=1e-6, atol=1e-6)
