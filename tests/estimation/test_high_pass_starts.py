"""Starts of high-pass filters in the lines and means of records: elimination, gradients, estimates."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.estimation.likelihood import data_chi2, data_curvature
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.estimation.transients import transient_columns
from balance_cli.model.balance import balance_model
from balance_cli.model.placed_effects import add_effects
from balance_cli.model.transient_modes import transient_modes
from balance_cli.signals.waveform_types import AnalysisWindow
from balance_cli.simulation import SweepPlan, draw_rig, simulate_campaign, simulate_run, true_rig
from balance_cli.simulation.plans import CampaignPlan
from balance_cli.simulation.preset_plans import short_plan
from balance_cli.simulation.rig import apply_effects
from balance_cli.steps.identify import identify
from tests.support.rigs import rotor_balance

RATE = 800.0


def rig_with_time_constant(time_constant=3.0):
    """The rotor balance with piezos of this time constant [s]."""
    geometry = rotor_balance()
    changes = {"time_constant": time_constant}
    channels = (c if c.time_constant is None else c.model_copy(update=changes) for c in geometry.channels)
    return geometry.model_copy(update={"channels": tuple(channels)})


def short_records(geometry, seed, period=1.0, periods=8, effects=()):
    """Static runs, and a sweep of each component, of a rig whose modes decay quickly."""
    rig = draw_rig(geometry, np.random.default_rng(seed))
    rig = apply_effects(replace(rig, damping_ratios=np.maximum(rig.damping_ratios, 0.008)), effects)
    changes = {"sweep": {"period": period, "periods": periods}, "static": {"steps": 5}}
    plan = [run.model_copy(update=changes[run.kind]) for run in short_plan().runs if run.kind in changes]
    return simulate_campaign(rig, CampaignPlan(runs=tuple(plan)), seed=seed)[0]


def test_start_of_a_high_pass_is_the_sum_over_the_samples():
    """One volt that decays with the rate of a channel; half of it in the channel with crosstalk."""
    geometry = add_effects(rig_with_time_constant(), ["crosstalk@x.strain,y1.piezo"])
    model = balance_model(geometry)
    theta = model.parameters.value.copy()
    theta[-1] = 0.5
    window = AnalysisWindow(np.array([2.0, 3.0]), 8.0, 1 / RATE, np.zeros((2, 1, 1), complex), np.inf)
    frequency = np.array([3.0, 17.0])
    free = transient_modes(model.system(theta), 0.0, RATE / 2, 1.0)
    columns = transient_columns(free, window, frequency)
    names = geometry.channel_names
    piezos = [i for i, name in enumerate(names) if name.endswith("piezo")]
    expected = []
    for f, start in zip(frequency, window.start, strict=True):
        t = np.arange(round(start * RATE), round(8 * RATE)) / RATE
        expected.append(2 * np.mean(np.exp(-t / 3.0 - 2j * np.pi * f * t)))
    column = columns[:, :, free.oscillating + piezos.index(names.index("y1.piezo"))]
    np.testing.assert_allclose(column[:, names.index("y1.piezo")], expected, rtol=1e-9)
    np.testing.assert_allclose(column[:, names.index("x.strain")], 0.5 * np.array(expected), rtol=1e-9)
    assert np.count_nonzero(np.abs(column[0])) == 2
    assert columns.shape[2] == 2 * free.oscillating + len(piezos)


def test_gradient_with_the_start_of_high_passes_is_exact():
    """By a cutoff and a crosstalk, which change the decays, and by parameters of the plate."""
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
        above, below = (data_chi2(batches, model.system(theta + change)) for change in (step, -step))
        assert curvature.gradient[place] == pytest.approx((above - below) / (4e-4 * scale[index]), rel=1e-5), name


LEAK = DeclaredEffect(name="high-pass", where=("z1.strain",), parameters={"cutoff": 0.04})


@pytest.fixture(scope="module")
def leaky():
    """Lines of a stepped record of 8 s, in which a strain channel has a high-pass; and the line of its mean."""
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


def test_after_a_high_pass_the_mean_has_no_information_on_an_offset(leaky):
    """Except for the prior: the offset is not many times the rms of the channel."""
    lines, _ = leaky
    without = information_on_the_offset(lines, [])
    assert without > 1e9
    assert information_on_the_offset(lines, ["high-pass@z1.strain"]) < 1e-7 * without


def test_mean_after_a_high_pass_needs_no_offset(leaky):
    """Of eight channels that measure a mean, one does not begin at its zero."""
    batches = stack_runs([leaky[1]], [], rotor_balance().channel_names)
    leaky_geometry = rotor_balance().model_copy(update={"effects": (LEAK,)})
    assert data_chi2(batches, balance_model(rotor_balance()).system()) > 150.0
    assert data_chi2(batches, balance_model(leaky_geometry).system()) < 30.0


def test_gradient_with_the_start_of_a_high_pass_in_the_mean_is_exact(leaky):
    """With crosstalk another channel reads that start too, so that it is not eliminated entirely."""
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
            above, below = (data_chi2(batches, model.system(theta + change)) for change in (step, -step))
            assert curvature.gradient[place] == pytest.approx((above - below) / (4e-4 * scale[index]), rel=1e-5), name


@pytest.mark.parametrize(("period", "periods", "seed"), [(1.0, 8, 1), (1.0, 14, 2), (2.0, 4, 3)])
def test_chi_square_of_short_records_is_that_of_noise(period, periods, seed):
    """The start of the piezo channels lasts to the end of the record and is eliminated."""
    geometry = rotor_balance()
    assert {channel.time_constant for channel in geometry.channels} == {None, 3.0}
    model = identify(measured_spectra(short_records(geometry, seed, period, periods), geometry), geometry)
    assert 0.98 < model.quality.chi2_per_dof < 1.03


def test_cutoff_in_short_records_has_no_bias():
    """Two high-passes of one channel, one of which is not declared: three rigs."""
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
    """The start of a fast high-pass has decayed before every window; a channel without one has no such start."""
    fast, slow = (balance_model(rig_with_time_constant(tau)).system() for tau in (0.05, 3.0))
    piezos = sum(name.endswith("piezo") for name in fast.channel_names)
    modes = [transient_modes(system, 0.0, RATE / 2, 18.4 / 2.0) for system in (fast, slow)]
    assert [np.count_nonzero(free.s.imag == 0) for free in modes] == [0, piezos]
    np.testing.assert_array_equal(modes[1].s[:-piezos], modes[0].s)
