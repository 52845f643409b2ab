"""The likelihood: elimination of the true loads, gradient, information, weights."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.estimation import batch as batch_module
from balance_cli.estimation.batch import split_large_batches
from balance_cli.estimation.equation_error import VARIANCE_ROUNDS, equation_error, fit_equation_error, measured_forces
from balance_cli.estimation.inner_products import information_product, real_inner_product
from balance_cli.estimation.likelihood import count_measured_values, data_chi2, data_curvature
from balance_cli.estimation.measurements import stack_runs
from balance_cli.estimation.static_lines import static_lines
from balance_cli.model.balance import balance_model
from balance_cli.model.system_response import response, solve
from balance_cli.signals.run_spectrum import RunSpectrum, StaticPoints
from tests.support.exciter_response import exciter_response
from tests.support.rigs import one_degree_of_freedom, rotor_balance

FREQUENCY = np.linspace(3.0, 120.0, 40)


def circular(rng, *shape):
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)


def noisy_lines(rig, rng, components=("Fx", "My"), noise=1e-3, load_noise=0.05, loads=20.0):
    """Lines of a two-component run from the model's own response, with correlated noise of known covariance."""
    system = balance_model(rig).system()
    columns = [("Fx", "Fy", "Fz", "Mx", "My", "Mz").index(name) for name in components]
    T = response(system, solve(system, FREQUENCY))[:, :, columns]
    c, u = T.shape[1:]
    mixing = np.diag([noise] * c + [load_noise] * u) @ (np.eye(c + u) + 0.2 * rng.standard_normal((c + u, c + u)))
    U = loads * circular(rng, len(FREQUENCY), u)
    z = np.concatenate([np.einsum("kcu,ku->kc", T, U), U], axis=1) + circular(rng, len(FREQUENCY), c + u) @ mixing.T
    covariance = np.broadcast_to((mixing @ mixing.T).astype(complex), (len(FREQUENCY), c + u, c + u))
    names = rig.channel_names
    return RunSpectrum("run", names, components, FREQUENCY, z[:, :c], z[:, c:], covariance, np.inf)


def test_chi2_is_the_least_over_all_true_loads():
    rig = rotor_balance()
    lines = noisy_lines(rig, np.random.default_rng(0))
    model = balance_model(rig)
    batches = stack_runs([lines], [], rig.channel_names)
    system = model.system()
    T = exciter_response(system, solve(system, FREQUENCY))[:, :, [0, 4]]
    total = 0.0
    for k in range(len(FREQUENCY)):
        L = np.linalg.cholesky(lines.covariance[k])
        M = np.linalg.solve(L, np.vstack([T[k], np.eye(2)]))
        z = np.linalg.solve(L, np.concatenate([lines.channels[k], lines.loads[k]]))
        residual = z - M @ np.linalg.lstsq(M, z, rcond=None)[0]
        total += 2 * np.vdot(residual, residual).real
    assert data_chi2(batches, system) == pytest.approx(total, rel=1e-9)


def test_chi2_of_the_truth_is_the_degrees_of_freedom():
    rig = rotor_balance()
    rng = np.random.default_rng(1)
    values = []
    for _ in range(30):
        batches = stack_runs([noisy_lines(rig, rng)], [], rig.channel_names)
        values.append(data_chi2(batches, balance_model(rig).system()))
    dof = count_measured_values(batches)
    assert np.mean(values) == pytest.approx(dof, abs=4 * np.sqrt(2 * dof / 30))


def test_gradient_is_exact_also_far_from_the_minimum():
    rig = rotor_balance()
    batches = stack_runs([noisy_lines(rig, np.random.default_rng(2), load_noise=2.0)], [], rig.channel_names)
    model = balance_model(rig)
    parameters = model.parameters
    theta = parameters.value + 0.3 * parameters.sigma
    curvature = data_curvature(batches, model.system(theta))
    for place, index in enumerate(np.flatnonzero(parameters.free)):
        step = 1e-5 * parameters.scale[index] * np.eye(len(theta))[index]
        change = data_chi2(batches, model.system(theta + step)) - data_chi2(batches, model.system(theta - step))
        numerical = change / (4e-5 * parameters.scale[index])
        size = np.sqrt(curvature.information[place, place] * curvature.chi2)
        assert curvature.gradient[place] == pytest.approx(numerical, rel=1e-4, abs=1e-5 * size), parameters.names[index]


def test_large_batches_are_derived_run_by_run_and_give_the_same(monkeypatch):
    rig = rotor_balance()
    rng = np.random.default_rng(5)
    runs = [replace(noisy_lines(rig, rng, (name,)), run=name) for name in ("Fx", "My", "Fz")]
    batches = stack_runs(runs, [], rig.channel_names)
    model = balance_model(rig)
    system = model.system(model.parameters.value + 0.3 * model.parameters.sigma)
    assert split_large_batches(batches, system.parameters) == batches
    whole = data_curvature(batches, system)
    monkeypatch.setattr(batch_module, "MAX_DERIVATIVE_BYTES", 2**10)
    parts = split_large_batches(batches, system.parameters)
    assert [part.run_names for part in parts] == [("Fx",), ("My",), ("Fz",)]
    split = data_curvature(batches, system)
    size = np.sqrt(np.diag(whole.information))
    assert split.chi2 == pytest.approx(whole.chi2, rel=1e-13)
    assert np.all(np.abs(split.gradient - whole.gradient) <= 1e-12 * size * np.sqrt(whole.chi2))
    assert np.all(np.abs(split.information - whole.information) <= 1e-12 * np.outer(size, size))


def test_information_predicts_the_scatter_of_the_estimate():
    """One step from the truth in 400 draws: covariance of the steps against the inverse information."""
    rig = one_degree_of_freedom()
    model = balance_model(rig)
    rng = np.random.default_rng(3)
    steps = []
    for _ in range(400):
        lines = noisy_lines(rig, rng, components=("Fz",), loads=5.0)
        curvature = data_curvature(stack_runs([lines], [], rig.channel_names), model.system())
        damping = [0, 2]
        inside = curvature.information[np.ix_(damping, damping)]
        steps.append(np.linalg.solve(inside, -curvature.gradient[damping]) * np.sqrt(np.diag(inside)))
    expected = np.linalg.inv(inside) * np.sqrt(np.outer(np.diag(inside), np.diag(inside)))
    np.testing.assert_allclose(np.cov(np.array(steps).T), expected, atol=0.3 * np.max(np.diag(expected)))


def test_a_channel_that_a_run_lacks_weighs_nothing():
    rig = rotor_balance()
    lines = noisy_lines(rig, np.random.default_rng(4))
    keep = [i for i, name in enumerate(lines.channel_names) if name != "z2.piezo"]
    signals = [*keep, 15, 16]
    less = RunSpectrum(
        "less",
        tuple(lines.channel_names[i] for i in keep),
        lines.components,
        lines.frequency,
        lines.channels[:, keep],
        lines.loads,
        lines.covariance[:, signals][:, :, signals],
        np.inf,
    )
    batches = stack_runs([less], [], rig.channel_names)
    assert count_measured_values(batches) == 2 * 14 * len(FREQUENCY)
    disturbed = stack_runs([less], [], rig.channel_names)
    disturbed[0].lines.channels[:, lines.channel_names.index("z2.piezo")] = 7.0
    system = balance_model(rig).system()
    assert data_chi2(disturbed, system) == data_chi2(batches, system)


def test_static_rows_enter_without_loss():
    """Chi-square of the rows about C0 = chi-square of the lines + that of the rows about their linear regression."""
    rng = np.random.default_rng(5)
    rig = rotor_balance()
    names = tuple(name for name in rig.channel_names if not name.endswith("piezo"))
    rows = [rig.channel_names.index(name) for name in names]
    system = balance_model(rig).system()
    C0 = response(system, solve(system, np.zeros(1)))[0, rows].real
    loads = rng.normal(size=(40, 6)) * 100.0
    root = np.diag(rng.uniform(1e-4, 3e-4, len(names)))
    channels = loads @ C0.T + 0.3 + rng.normal(size=(40, len(names))) @ root
    points = StaticPoints("static", "bare", names, channels, loads, root @ root, np.inf)
    batches = stack_runs([], [points], rig.channel_names)
    assert count_measured_values(batches) == 6 * len(names)

    def rows_chi2(matrix):
        residual = channels - channels.mean(0) - (loads - loads.mean(0)) @ matrix.T
        return float(np.sum((residual / np.diag(root)) ** 2))

    best = np.linalg.lstsq(loads - loads.mean(0), channels - channels.mean(0), rcond=None)[0].T
    assert data_chi2(batches, system) == pytest.approx(rows_chi2(C0) - rows_chi2(best), rel=1e-8)
    assert static_lines(points).components == ("Fx", "Fy", "Fz", "Mx", "My", "Mz")


def test_equation_error_vanishes_at_the_truth_and_its_derivatives_are_exact():
    rig = rotor_balance()
    lines = noisy_lines(rig, np.random.default_rng(6), noise=1e-12, load_noise=1e-9)
    model = balance_model(rig)
    batch = stack_runs([lines], [], rig.channel_names)[0]
    measured = measured_forces(batch, model.system())
    error, derivatives = equation_error(model.system(), measured)
    assert np.abs(error).max() < 1e-5
    parameters = model.parameters
    for place, index in enumerate(np.flatnonzero(parameters.free)):
        step = 1e-5 * parameters.scale[index] * np.eye(len(parameters))[index]
        above = equation_error(model.system(parameters.value + step), measured)[0]
        below = equation_error(model.system(parameters.value - step), measured)[0]
        numerical = (above - below) / (2e-5 * parameters.scale[index])
        np.testing.assert_allclose(derivatives[:, :, place], numerical, atol=1e-6 * np.abs(numerical).max() + 1e-12)


def test_least_squares_finds_a_noise_free_rig_from_wrong_declarations():
    rig = rotor_balance()
    clean = [
        noisy_lines(rig, np.random.default_rng(i), components=(name,), noise=1e-9, load_noise=1e-9)
        for i, name in enumerate(("Fx", "Fy", "Fz", "Mx", "My", "Mz"))
    ]
    wrong = rig.model_copy(
        update={"cells": tuple(cell.model_copy(update={"stiffness": 1.04 * cell.stiffness}) for cell in rig.cells)}
    )
    model, truth = balance_model(wrong), balance_model(rig)
    fit = fit_equation_error(model.parameters, stack_runs(clean, [], rig.channel_names), model.system, (1.0, 150.0))
    fitted, true = (response(s, solve(s, FREQUENCY)) for s in (model.system(fit.theta), truth.system()))
    assert np.linalg.norm(fitted - true) < 0.02 * np.linalg.norm(true)


def test_least_squares_take_errors_alone_without_derivatives():
    rig = rotor_balance()
    model, asked = balance_model(rig), []

    def system(theta, derivatives=True):
        asked.append(derivatives)
        return model.system(theta, derivatives)

    lines = noisy_lines(rig, np.random.default_rng(6), noise=1e-9, load_noise=1e-9)
    fit = fit_equation_error(model.parameters, stack_runs([lines], [], rig.channel_names), system, (1.0, 150.0))
    assert fit.converged and asked.count(False) >= VARIANCE_ROUNDS


@pytest.mark.parametrize("wide", [0, 3])
def test_information_of_parameters_that_show_in_one_channel_is_the_product_of_all(wide):
    rng, count = np.random.default_rng(3), 9
    root = circular(rng, 70, 4, 4)  # more lines than one step takes
    precision = root @ root.conj().swapaxes(1, 2)
    derivatives = circular(rng, 70, 4, count + wide)
    for parameter in range(count):
        derivatives[:, np.arange(4) != parameter % 4, parameter] = 0.0
    derivatives[:, :, count - 1] = 0.0  # shows nowhere
    expected = real_inner_product(derivatives, precision @ derivatives)
    np.testing.assert_allclose(
        information_product(derivatives, precision), expected, atol=1e-12 * np.abs(expected).max()
    )
    assert np.count_nonzero(expected) > count


def test_runs_at_two_levels_share_the_derivatives_per_unit_load():
    """Against each run alone, which has no second level to share them with."""
    rig = rotor_balance()
    rng = np.random.default_rng(6)
    runs = [
        replace(noisy_lines(rig, rng, (name,), loads=size), run=f"{name} {size}")
        for name in ("Fx", "My")
        for size in (5.0, 20.0)
    ]
    model = balance_model(rig)
    system = model.system(model.parameters.value + 0.3 * model.parameters.sigma)
    together = data_curvature(stack_runs(runs, [], rig.channel_names), system)
    alone = [data_curvature(stack_runs([run], [], rig.channel_names), system) for run in runs]
    size = np.sqrt(np.diag(together.information))
    information = sum(item.information for item in alone)
    gradient = sum(item.gradient for item in alone)
    assert np.all(np.abs(together.information - information) <= 1e-12 * np.outer(size, size))
    assert np.all(np.abs(together.gradient - gradient) <= 1e-12 * size * np.sqrt(together.chi2))
