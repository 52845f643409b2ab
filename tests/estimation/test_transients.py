"""Records that begin at rest: the free motion in their lines, against sums in time, and what it does to estimates."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.estimation.likelihood import data_chi2, data_curvature, evaluate_batch
from balance_cli.estimation.measured_spectra import Spectra, measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.estimation.transients import transient_columns
from balance_cli.model.balance import balance_model
from balance_cli.model.parameters import declared_parameters
from balance_cli.model.placed_effects import add_effects
from balance_cli.model.system_response import solve
from balance_cli.model.transient_modes import divided_differences, transient_modes
from balance_cli.signals.periodic import periodic_record
from balance_cli.signals.waveform_types import AnalysisWindow
from balance_cli.simulation import SweepPlan, draw_rig, simulate_campaign, simulate_run, true_rig
from balance_cli.simulation.plans import CampaignPlan, short_plan, standard_plan
from balance_cli.simulation.rig import apply_effects
from balance_cli.steps.identify import IdentifyOptions, identify
from tests.support.rigs import one_degree_of_freedom, rotor_balance, two_degrees_of_freedom
from tests.support.truth import response_errors, true_parameters

RATE = 800.0


def without_windows(spectra: Spectra) -> Spectra:
    """The same lines to whom nobody told when they were recorded."""
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
    # The answer of the low-pass to the free motion, its own start gone: (1 + tau A)^-1 of the state.
    slow = np.linalg.solve(np.eye(4) + tau * A, states.T).T
    forces = system.readings.value
    volts = 0.002 * np.stack([slow[:, :2] @ forces[0], states[:, :2] @ forces[1]], axis=1)
    free = transient_modes(system, 0.0, RATE / 2)
    found = transient_columns(free, window, frequency)
    lines = []
    for f, t_f in zip(frequency, starts, strict=True):
        k = np.arange(round(t_f * RATE), first + count)
        lines.append(2.0 / len(k) * np.exp(-2j * np.pi * f * step * k) @ volts[k])
    # Four real amplitudes are found from six complex lines: nothing may be left.
    design, data = found.reshape(-1, 4), np.array(lines).reshape(-1)
    both = np.concatenate([design.real, design.imag]), np.concatenate([data.real, data.imag])
    left = both[1] - both[0] @ np.linalg.lstsq(*both, rcond=None)[0]
    assert np.abs(left).max() < 1e-9 * np.abs(data).max()


def test_gradient_with_free_motion_is_exact():
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


def test_equal_frequencies_have_slopes():
    """Heave and pitch of one frequency: the pair moves as a whole, and the gradient stays exact."""
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


def forgetful(time_constant=3.0):
    """The rotor balance with piezos of this time constant [s]."""
    geometry = rotor_balance()
    kept = {"time_constant": time_constant}
    channels = (c if c.time_constant is None else c.model_copy(update=kept) for c in geometry.channels)
    return geometry.model_copy(update={"channels": tuple(channels)})


def short_records(geometry, seed, period=1.0, periods=8, effects=()):
    """Static runs, and a sweep of each component, of a rig whose modes do not ring for long."""
    rig = draw_rig(geometry, np.random.default_rng(seed))
    rig = apply_effects(replace(rig, damping_ratios=np.maximum(rig.damping_ratios, 0.008)), effects)
    kept = {"sweep": {"period": period, "periods": periods}, "static": {"steps": 5}}
    plan = [one.model_copy(update=kept[one.kind]) for one in short_plan().runs if one.kind in kept]
    return simulate_campaign(rig, CampaignPlan(runs=tuple(plan)), seed=seed)[0]


def test_start_of_a_high_pass_is_the_sum_over_the_samples():
    """One volt of a channel that decays with its rate; half of it in the channel that takes that up."""
    geometry = add_effects(forgetful(), ["crosstalk@x.strain,y1.piezo"])
    model = balance_model(geometry)
    theta = model.parameters.value.copy()
    theta[-1] = 0.5
    window = AnalysisWindow(np.array([2.0, 3.0]), 8.0, 1 / RATE, np.zeros((2, 1, 1), complex), np.inf)
    frequency = np.array([3.0, 17.0])
    found = transient_columns(transient_modes(model.system(theta), 0.0, RATE / 2, 1.0), window, frequency)
    names = geometry.channel_names
    piezos = [i for i, name in enumerate(names) if name.endswith("piezo")]
    expected = []
    for f, start in zip(frequency, window.start, strict=True):
        t = np.arange(round(start * RATE), round(8 * RATE)) / RATE
        expected.append(2 * np.mean(np.exp(-t / 3.0 - 2j * np.pi * f * t)))
    m, own = found.shape[2] // 2, piezos.index(names.index("y1.piezo"))
    column = found[:, :, m - len(piezos) + own]
    np.testing.assert_allclose(column[:, names.index("y1.piezo")], expected, rtol=1e-9)
    np.testing.assert_allclose(column[:, names.index("x.strain")], 0.5 * np.array(expected), rtol=1e-9)
    assert np.count_nonzero(np.abs(column[0])) == 2
    assert np.abs(found[:, :, 2 * m - len(piezos) :]).max() < 1e-15


def test_gradient_with_the_start_of_high_passes_is_exact():
    """Of a cutoff and a crosstalk, which shape the decays, and of what shapes the rest."""
    geometry = add_effects(rotor_balance(), ["high-pass@x.piezo", "high-pass@z1.strain", "crosstalk@x.strain,y1.piezo"])
    runs = [run for run in short_records(rotor_balance(), 3) if run.name in ("sweep-Fx", "sweep-My")]
    spectra = measured_spectra(runs, geometry)
    batches = stack_runs(spectra.lines, spectra.statics, geometry.channel_names)
    model = balance_model(geometry)
    theta, scale = model.parameters.value.copy(), model.parameters.scale
    theta[-3:] = (0.01, 0.02, 0.03)
    names = (*model.parameters.names[-3:], "stiffness.x", "centre_of_gravity.z")
    assert all("high-pass" in name or "crosstalk" in name for name in names[:3])
    curvature = data_curvature(batches, model.system(theta))
    free = [model.parameters.names[i] for i in np.flatnonzero(model.parameters.free)]
    for name in names:
        place, index = free.index(name), model.parameters.index(name)
        step = 1e-4 * scale[index] * np.eye(len(theta))[index]
        above, below = (data_chi2(batches, model.system(theta + one)) for one in (step, -step))
        assert curvature.gradient[place] == pytest.approx((above - below) / (4e-4 * scale[index]), rel=1e-5), name


LEAK = DeclaredEffect(name="high-pass", where=("z1.strain",), parameters={"cutoff": 0.04})


@pytest.fixture(scope="module")
def leaky():
    """Lines of a stepped record of 8 s, in which a strain channel with a high-pass forgets where it began; its mean."""
    plan = SweepPlan(run="sweep", excited=("Fz",), level=(40.0,), excitation="stepped", period=1.0, periods=8)
    run, _ = simulate_run(apply_effects(true_rig(rotor_balance()), [LEAK]), plan, seed=3)
    (lines,) = measured_spectra([run], rotor_balance(), means=True).lines
    assert lines.window is None
    return lines, lines.select(lines.frequency == 0)


def information_on_the_offset(lines, effects):
    model = balance_model(add_effects(rotor_balance(), [*effects, "channel-offset@z1.strain"]))
    theta = model.parameters.value.copy()
    theta[["cutoff" in name for name in model.parameters.names]] = 0.04
    curvature = data_curvature(stack_runs([lines], [], rotor_balance().channel_names), model.system(theta))
    free = [model.parameters.names[i] for i in np.flatnonzero(model.parameters.free)]
    place = free.index("channel-offset@z1.strain.offset")
    return curvature.information[place, place]


def test_behind_a_high_pass_the_mean_tells_nothing_of_an_offset(leaky):
    """But that it is not many times what the channel reads at all."""
    lines, _ = leaky
    told = information_on_the_offset(lines, [])
    assert told > 1e9
    assert information_on_the_offset(lines, ["high-pass@z1.strain"]) < 1e-7 * told


def test_mean_behind_a_high_pass_needs_no_offset(leaky):
    """Of eight channels that tell a mean, one begins elsewhere than at its zero."""
    batches = stack_runs([leaky[1]], [], rotor_balance().channel_names)
    known = rotor_balance().model_copy(update={"effects": (LEAK,)})
    assert data_chi2(batches, balance_model(rotor_balance()).system()) > 150.0
    assert data_chi2(batches, balance_model(known).system()) < 30.0


def test_gradient_with_the_start_of_a_high_pass_in_the_mean_is_exact(leaky):
    """Crosstalk lets another channel read that start, so that not all of it goes."""
    effects = ["high-pass@z1.strain", "crosstalk@x.strain,z1.strain", "channel-offset@x.strain"]
    model = balance_model(add_effects(rotor_balance(), [*effects, "channel-offset@z1.strain"]))
    theta, scale = model.parameters.value.copy(), model.parameters.scale
    theta[-4:] = (0.02, 0.03, 1e-3, 1e-3)
    free = [model.parameters.names[i] for i in np.flatnonzero(model.parameters.free)]
    for lines in leaky:
        batches = stack_runs([lines], [], rotor_balance().channel_names)
        curvature = data_curvature(batches, model.system(theta))
        assert curvature.chi2 == data_chi2(batches, model.system(theta))
        for name in model.parameters.names[-4:]:
            place, index = free.index(name), model.parameters.index(name)
            step = 1e-4 * scale[index] * np.eye(len(theta))[index]
            above, below = (data_chi2(batches, model.system(theta + one)) for one in (step, -step))
            assert curvature.gradient[place] == pytest.approx((above - below) / (4e-4 * scale[index]), rel=1e-5), name


@pytest.mark.parametrize(("period", "periods", "seed"), [(1.0, 8, 1), (1.0, 14, 2), (2.0, 4, 3)])
def test_chi_square_of_short_records_is_that_of_noise(period, periods, seed):
    """The piezos' own start is there to the end of the record, and is eliminated."""
    geometry = rotor_balance()
    assert {channel.time_constant for channel in geometry.channels} == {None, 3.0}
    model = identify(measured_spectra(short_records(geometry, seed, period, periods), geometry), geometry)
    assert 0.98 < model.quality.chi2_per_dof < 1.03


def test_cutoff_in_short_records_has_no_bias():
    """Two high-passes of one channel, one of which nothing is declared of: three rigs."""
    true, errors = 0.03, []
    declared = DeclaredEffect(name="high-pass", where=("x.piezo",), parameters={"cutoff": true})
    for seed in range(1, 4):
        geometry = add_effects(rotor_balance(), ["high-pass@x.piezo"])
        spectra = measured_spectra(short_records(rotor_balance(), seed, effects=[declared]), geometry)
        model = identify(spectra, geometry)
        assert 0.98 < model.quality.chi2_per_dof < 1.03
        errors.append((model.parameters.value[-1] - true) / model.parameters.sigma[-1])
    assert np.abs(errors).max() < 3.0
    assert np.abs(np.mean(errors)) < 3.0 / np.sqrt(len(errors))
    assert model.parameters.sigma[-1] < 0.05 * true


def test_what_has_decayed_is_not_eliminated():
    """Of a fast high-pass nothing is left at the start of any window; without one there is nothing to begin with."""
    fast, slow = (balance_model(forgetful(tau)).system() for tau in (0.05, 3.0))
    piezos = sum(name.endswith("piezo") for name in fast.channel_names)
    modes = [transient_modes(system, 0.0, RATE / 2, 18.4 / 2.0) for system in (fast, slow)]
    assert [np.count_nonzero(free.s.imag == 0) for free in modes] == [0, piezos]
    np.testing.assert_array_equal(modes[1].s[:-piezos], modes[0].s)


def test_divided_differences_pass_into_the_derivative():
    s = np.array([1.0 + 2.0j, 1.0 + 2.0j, 0.5j])
    found = divided_differences(s**2, 2 * s, s)
    np.testing.assert_allclose(found, s[:, None] + s, rtol=1e-12)


@pytest.fixture(scope="module")
def ringing():
    """A mode of a tenth of a per cent that rings through the record; its damping in sigma, with and without."""
    geometry = one_degree_of_freedom(damping_ratio=0.0013)
    errors = {"with": [], "without": []}
    chi2 = []
    for seed in range(6):
        run = swept(true_rig(geometry, stiffness=[4.03e5], damping_ratios=[0.001]), seed)
        spectra = measured_spectra([run], geometry)
        model = identify(spectra, geometry, IdentifyOptions(method="ml"))
        other = identify(without_windows(spectra), geometry, IdentifyOptions(method="ml"))
        chi2.append(model.quality.chi2_per_dof)
        for name, one in (("with", model), ("without", other)):
            errors[name].append((one.modes.damping_ratio[0] - 0.001) / one.modes.sigma_damping_ratio[0])
    return np.array(errors["with"]), np.array(errors["without"]), np.array(chi2)


def test_damping_of_a_ringing_mode_has_no_bias(ringing):
    with_it, without, chi2 = ringing
    assert np.abs(with_it).max() < 4.0
    assert np.sqrt(np.mean(with_it**2)) < 2.0
    assert np.sqrt(np.mean(without**2)) > 2.0 * np.sqrt(np.mean(with_it**2))
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.1)


def test_a_rig_with_a_mode_that_never_settles_is_found_within_its_sigma():
    geometry = rotor_balance()
    rig = draw_rig(geometry, np.random.default_rng(11))
    assert rig.damping_ratios.min() < 5e-4
    plan = standard_plan()
    plan = CampaignPlan(runs=tuple(one for one in plan.runs if one.run.endswith(("-high", "-bare"))))
    runs, _ = simulate_campaign(rig, plan, seed=4)
    model = identify(measured_spectra(runs, geometry), geometry)
    error, predicted = response_errors(rig, model)
    assert np.all(np.percentile(error, 95, axis=0) < 2.2 * np.percentile(predicted, 95, axis=0))
    truth = true_parameters(rig, declared_parameters(geometry))
    free = model.parameters.declared_sigma > 0
    assert np.abs((model.parameters.value - truth)[free] / model.parameters.sigma[free]).max() < 4.0
    assert model.quality.chi2_per_dof == pytest.approx(1.0, abs=0.05)


def test_a_record_that_has_settled_loses_next_to_nothing():
    """With 5 % of damping nothing is left after the first period; sigma is what it is without free motion."""
    geometry = one_degree_of_freedom(damping_ratio=0.05)
    run = swept(true_rig(geometry))
    spectra = measured_spectra([run], geometry)
    model = balance_model(geometry)
    window = spectra.lines[0].window
    assert window is not None
    late = replace(spectra.lines[0], window=replace(window, start=np.maximum(window.start, 2.0)))
    bare = replace(late, window=None, covariance=window.covariance, dof=window.dof)
    one, other = (data_curvature(stack_runs([x], [], geometry.channel_names), model.system()) for x in (late, bare))
    np.testing.assert_allclose(one.information, other.information, rtol=1e-3)
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
        for one in (run, quiet):
            record = periodic_record(one, geometry.channel_names)
            window = record.spectrum.window
            assert window is not None
            noise.append(np.median(window.covariance[:, 0, 0].real * (record.periods - record.first)))
        ratios.append(noise[0] / noise[1])
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.1)
