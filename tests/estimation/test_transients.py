"""Transients of records that begin at rest: their lines against sums in time, and their influence on estimates."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.estimation.likelihood import count_measured_values, data_chi2, data_curvature, evaluate_batch
from balance_cli.estimation.measured_spectra import Spectra, measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.estimation.transients import transient_columns
from balance_cli.model.balance import balance_model
from balance_cli.model.parameters import declared_parameters
from balance_cli.model.system_response import solve
from balance_cli.model.transient_modes import divided_differences, transient_modes
from balance_cli.signals.periodic import periodic_record
from balance_cli.signals.waveform_types import AnalysisWindow
from balance_cli.simulation import SweepPlan, draw_rig, simulate_campaign, simulate_run, true_rig
from balance_cli.simulation.plans import CampaignPlan
from balance_cli.simulation.preset_plans import short_plan, standard_plan
from balance_cli.steps.identify import IdentifyOptions, identify
from tests.support.rigs import one_degree_of_freedom, rotor_balance, two_degrees_of_freedom
from tests.support.truth import response_errors, true_parameters

RATE = 800.0


def without_windows(spectra: Spectra) -> Spectra:
    """The same lines without the windows from which they were computed, so that no transient is modeled."""
    return replace(spectra, lines=tuple(replace(lines, window=None) for lines in spectra.lines))


def swept(rig, seed=1, **changes):
    plan = {"run": "sweep", "excited": ("Fz",), "level": (20.0,), "periods": 7, "period": 2.0, **changes}
    return simulate_run(rig, SweepPlan(**plan), seed=seed)[0]


def test_columns_are_the_sums_over_the_samples():
    """Two modes with a low-pass and a high-pass channel, from the state-space exponential."""
    rig = two_degrees_of_freedom()
    channels = [rig.channels[0].model_copy(update={"lowpass": 90.0}), rig.channels[1]]
    rig = rig.model_copy(update={"channels": tuple(channels)})
    system = balance_model(rig).system()
    pencil = system.pencil
    M, D, K = pencil.mass.value, pencil.damping.value, pencil.stiffness.value
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    step, count, first = 1.0 / RATE, 1600, 800
    frequency, starts = np.array([2.0, 11.0, 16.0]), np.array([1.0, 1.0, 2.0])
    window = AnalysisWindow(starts, 3.0, step, np.zeros((3, 2, 2), complex), np.inf)
    x0 = np.array([1e-4, -3e-4, 2e-3, 1e-2])
    states = np.array([expm(A * step * k) @ x0 for k in range(first + count)])
    tau = 1.0 / (2 * np.pi * 90.0)
    # The response of the low-pass to the transient, without its own start: (1 + tau A)^-1 of the state.
    slow = np.linalg.solve(np.eye(4) + tau * A, states.T).T
    forces = system.readings.value
    volts = 0.002 * np.stack([slow[:, :2] @ forces[0], states[:, :2] @ forces[1]], axis=1)
    free = transient_modes(system, 0.0, RATE / 2)
    columns = transient_columns(free, window, frequency)
    lines = []
    for f, t_f in zip(frequency, starts, strict=True):
        k = np.arange(round(t_f * RATE), first + count)
        lines.append(2.0 / len(k) * np.exp(-2j * np.pi * f * step * k) @ volts[k])
    # Four real amplitudes are fitted to six complex lines: the residual must vanish.
    design, data = columns.reshape(-1, 4), np.array(lines).reshape(-1)
    A, b = np.concatenate([design.real, design.imag]), np.concatenate([data.real, data.imag])
    residual = b - A @ np.linalg.lstsq(A, b, rcond=None)[0]
    assert np.abs(residual).max() < 1e-9 * np.abs(data).max()


def test_gradient_with_transients_is_exact():
    geometry = rotor_balance()
    rig = draw_rig(geometry, np.random.default_rng(11))
    names = ("sweep-Fx", "sweep-My", "sweep-Mz", "static-bare")
    runs, _ = simulate_campaign(rig, short_plan().select_runs(names), seed=4)
    spectra = measured_spectra(runs, geometry)
    batches = stack_runs(spectra.lines, spectra.statics, geometry.channel_names)
    model = balance_model(geometry)
    parameters = model.parameters
    theta = parameters.value + 0.03 * parameters.sigma
    curvature = data_curvature(batches, model.system(theta))
    assert curvature.chi2 == data_chi2(batches, model.system(theta))
    for place, index in enumerate(np.flatnonzero(parameters.free)):
        step = 1e-5 * parameters.scale[index] * np.eye(len(theta))[index]
        change = data_chi2(batches, model.system(theta + step)) - data_chi2(batches, model.system(theta - step))
        numerical = change / (4e-5 * parameters.scale[index])
        size = np.sqrt(curvature.information[place, place] * curvature.chi2)
        assert curvature.gradient[place] == pytest.approx(numerical, rel=1e-5, abs=1e-7 * size), parameters.names[index]


def test_equal_frequencies_have_derivatives():
    """Heave and pitch at one frequency: the pair is treated as a whole, and the gradient is exact."""
    rig = two_degrees_of_freedom()
    body = rig.bodies[0].model_copy(update={"inertia": rig.bodies[0].inertia.model_copy(update={"yy": 1.8})})
    rig = rig.model_copy(update={"bodies": (body,)})
    model = balance_model(rig)
    s = transient_modes(model.system(), 0.0, RATE / 2).s
    assert s[0] == pytest.approx(s[1], rel=1e-9)
    run = swept(true_rig(rig, stiffness=[1.02e6, 0.97e6]))
    batches = stack_runs(measured_spectra([run], rig).lines, [], rig.channel_names)
    theta = model.parameters.value
    gradient = data_curvature(batches, model.system()).gradient
    for place, index in enumerate(np.flatnonzero(model.parameters.free)):
        step = 1e-6 * model.parameters.scale[index] * np.eye(len(theta))[index]
        change = data_chi2(batches, model.system(theta + step)) - data_chi2(batches, model.system(theta - step))
        numerical = change / (4e-6 * model.parameters.scale[index])
        assert gradient[place] == pytest.approx(numerical, rel=1e-4, abs=1e-6 * np.abs(gradient).max())


def test_divided_differences_of_equal_values_are_the_derivative():
    s = np.array([1.0 + 2.0j, 1.0 + 2.0j, 0.5j])
    differences = divided_differences(s**2, 2 * s, s)
    np.testing.assert_allclose(differences, s[:, None] + s, rtol=1e-12)


@pytest.fixture(scope="module")
def ringing():
    """Error, absolute and in sigma, of the damping of a mode of 0.1 % that rings through the record, with and without a
    transient in the model."""
    geometry = one_degree_of_freedom(damping_ratio=0.0013)
    errors = {"with": [], "without": []}
    chi2 = []
    for seed in range(6):
        run = swept(true_rig(geometry, stiffness=[4.03e5], damping_ratios=[0.001]), seed)
        spectra = measured_spectra([run], geometry)
        model = identify(spectra, geometry, IdentifyOptions(method="ml"))
        blind = identify(without_windows(spectra), geometry, IdentifyOptions(method="ml"))
        chi2.append(model.quality.chi2_per_dof)
        for name, fit in (("with", model), ("without", blind)):
            error = fit.modes.damping_ratio[0] - 0.001
            errors[name].append((error, error / fit.modes.sigma_damping_ratio[0]))
    return np.array(errors["with"]), np.array(errors["without"]), np.array(chi2)


def test_damping_of_a_ringing_mode_has_no_bias(ringing):
    with_it, without, chi2 = ringing
    assert np.abs(with_it[:, 1]).max() < 4.0
    rms_with, rms_without = (np.sqrt(np.mean(errors**2, axis=0)) for errors in (with_it, without))
    assert rms_with[1] < 2.0
    assert rms_without[0] > 100.0 * rms_with[0]
    # The responses have the transient that is left in their covariance.
    assert rms_without[1] < 2.0
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.1)


def test_a_rig_with_a_mode_that_never_settles_is_found_within_its_sigma():
    geometry = rotor_balance()
    rig = draw_rig(geometry, np.random.default_rng(11))
    assert rig.damping_ratios.min() < 5e-4
    plan = standard_plan()
    plan = CampaignPlan(runs=tuple(run for run in plan.runs if run.run.endswith(("-high", "-bare"))))
    runs, _ = simulate_campaign(rig, plan, seed=4)
    model = identify(measured_spectra(runs, geometry), geometry)
    error, predicted = response_errors(rig, model)
    assert np.all(np.percentile(error, 95, axis=0) < 2.2 * np.percentile(predicted, 95, axis=0))
    truth = true_parameters(rig, declared_parameters(geometry))
    free = model.parameters.declared_sigma > 0
    assert np.abs((model.parameters.value - truth)[free] / model.parameters.sigma[free]).max() < 4.0
    assert model.quality.chi2_per_dof == pytest.approx(1.0, abs=0.05)


def test_a_record_without_transient_loses_hardly_any_information():
    """With 5 % damping the transient has decayed after the first period; sigma is as without a transient."""
    geometry = one_degree_of_freedom(damping_ratio=0.05)
    run = swept(true_rig(geometry))
    spectra = measured_spectra([run], geometry)
    model = balance_model(geometry)
    window = spectra.lines[0].window
    assert window is not None
    late = replace(spectra.lines[0], window=replace(window, start=np.maximum(window.start, 2.0)))
    bare = replace(late, window=None, covariance=window.covariance, dof=window.dof)
    with_it, without = (
        data_curvature(stack_runs([x], [], geometry.channel_names), model.system()) for x in (late, bare)
    )
    np.testing.assert_allclose(with_it.information, without.information, rtol=1e-3)
    batch = stack_runs([late], [], geometry.channel_names)[0]
    fit = evaluate_batch(batch, model.system(), solve(model.system(), batch.frequency))
    assert sum(part.effective_parameters for part in fit.transients) < 0.5


def test_noise_of_ringing_lines_is_that_of_the_record():
    """A line of a period of N samples of noise s has variance 4 s^2 / N, however much the mode rings."""
    geometry = one_degree_of_freedom(damping_ratio=0.001)
    ratios = []
    for seed in range(4):
        run = swept(true_rig(geometry), seed)
        quiet = swept(true_rig(one_degree_of_freedom(damping_ratio=0.2)), seed)
        noise = []
        for sweep in (run, quiet):
            record = periodic_record(sweep, geometry.channel_names)
            window = record.spectrum.window
            assert window is not None
            noise.append(np.median(window.covariance[:, 0, 0].real * (record.periods - record.first)))
        ratios.append(noise[0] / noise[1])
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.1)


def test_a_transient_rings_with_what_the_exciter_moves():
    """The mode of the record is that of the rig with the mass beyond the force cell: 30.3 Hz, without it 31.8 Hz."""
    geometry, moved = one_degree_of_freedom(damping_ratio=0.001), 0.1
    (body,) = geometry.bodies
    heavier = geometry.model_copy(update={"bodies": (body.model_copy(update={"mass": (1 + moved) * body.mass}),)})
    truth = true_rig(heavier, damping_ratios=[0.001 / np.sqrt(1 + moved)])
    effect = DeclaredEffect(name="exciter-mass", where=("Fz",), parameters={"mass": moved * body.mass})
    model = balance_model(geometry.model_copy(update={"effects": (effect,)}))
    batches = stack_runs(measured_spectra([swept(truth)], geometry).lines, [], geometry.channel_names)
    assert data_chi2(batches, model.system()) / count_measured_values(batches) == pytest.approx(1.0, abs=0.2)
