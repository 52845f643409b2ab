"""Loads say when they are not to be trusted."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.consistency.campaign import campaign_findings
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.io.errors import UserError
from balance_cli.reduction.flags import FLAGS, join_flags
from balance_cli.reduction.harmonic_loads import harmonic_loads
from balance_cli.reduction.kalman.innovations import InnovationTests
from balance_cli.reduction.measured_response import transfer_source
from balance_cli.reduction.model_sources import model_source
from balance_cli.reduction.result import flag_filter
from balance_cli.reduction.rotor_record import rotor_record
from balance_cli.reduction.trust import sensor_count
from balance_cli.report.in_time import innovation_tests_row
from balance_cli.signals.response.choices import INTERPOLATIONS
from balance_cli.signals.rotor.other_rotors import rotor_azimuth
from balance_cli.steps.cross_checks import keep_findings
from balance_cli.steps.identify import IdentifyOptions, identify
from balance_cli.steps.reduce import ReduceOptions, reduce_run
from balance_cli.steps.sweep_tf import estimate_responses
from tests.support.channels import with_channel


@pytest.fixture(scope="module")
def check(campaign):
    return campaign.runs_of_kind("check")[0]


def reduced_words(run):
    return {word for row in run.flags for flag in row for word in flag.split("; ") if word}


def test_flags_have_one_order_and_each_stands_once():
    assert join_flags(["redundancy", "", "no zero; redundancy", "untested"]) == "no zero; untested; redundancy"
    assert join_flags([]) == ""
    assert join_flags(FLAGS) == "; ".join(FLAGS)


def test_a_good_record_has_no_flag_but_the_missing_zero(campaign, calibration, identified, check):
    found = reduce_run(check, campaign.geometry, calibration, model_source(identified))
    assert reduced_words(found) == {"no zero", "untested"}
    untested = {
        (name, h) for h in range(9) for j, name in enumerate(found.components) if "untested" in found.flags[h][j]
    }
    assert {("Mz", h) for h in range(9)} <= untested <= {("Fx", 0), ("My", 0), *(("Mz", h) for h in range(9))}


def test_two_channels_of_a_cell_are_one_sensor(campaign):
    names = campaign.geometry.channel_names
    cells = {channel.cell for channel in campaign.geometry.channels}
    assert sensor_count(campaign.geometry, names) == len(cells)
    assert sensor_count(campaign.geometry, tuple(name for name in names if "piezo" not in name)) == len(cells)


def test_six_sensors_for_six_loads_are_untested_although_each_cell_has_two_channels(
    campaign, calibration, identified, check
):
    broken = check
    for name in [name for name in campaign.geometry.channel_names if name.startswith(("z4", "y2"))]:
        broken = with_channel(broken, name, np.zeros_like)
    found = reduce_run(broken, campaign.geometry, calibration, model_source(identified))
    assert all("untested" in flag for row in found.flags for flag in row)


def test_a_step_of_the_mean_load_is_not_steady(campaign, calibration, identified):
    wind = campaign.runs_of_kind("wind")[0]
    steady = reduce_run(wind, campaign.geometry, calibration, model_source(identified))
    assert "not steady" not in reduced_words(steady)

    def step(volts):
        return volts + np.where(np.arange(len(volts)) > 0.6 * len(volts), 0.3 * abs(np.mean(volts)), 0.0)

    stepped = wind
    for name in [name for name in campaign.geometry.channel_names if name.startswith("z") and "strain" in name]:
        stepped = with_channel(stepped, name, step)
    found = reduce_run(stepped, campaign.geometry, calibration, model_source(identified))
    lift = found.components.index("Fz")
    assert "not steady" in found.flags[0][lift]


def test_a_line_above_the_reduced_harmonics_flags_the_row_below_it(campaign, calibration, identified, check):
    found = reduce_run(check, campaign.geometry, calibration, model_source(identified), options=ReduceOptions(3))
    flagged = [all("unmodelled line" in flag for flag in row) for row in found.flags]
    assert flagged == [False, False, False, True]
    assert any("4/rev" in note and "1 to 3 are free of it; --harmonics 4" in note for note in found.notes)
    more = reduce_run(check, campaign.geometry, calibration, model_source(identified), options=ReduceOptions(8))
    np.testing.assert_allclose(found.amplitude, more.amplitude[:4], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.sigma_cosine[1:], more.sigma_cosine[1:4], rtol=0.05)


def test_a_channel_without_noise_is_contradicted_by_the_others(campaign, calibration, identified, check):
    """As of a coarse converter that repeats itself in each revolution."""
    azimuth = rotor_azimuth(check, 1)

    def repeat(volts):
        time = np.arange(len(volts)) / check.sample_rate
        psi = np.where(np.isfinite(azimuth.psi(time)), azimuth.psi(time), 2 * np.pi * check.rotor_speed * time)
        return np.round(sum(0.1 * np.cos(n * psi + n**2) for n in range(1, 9)), 1)

    found = reduce_run(
        with_channel(check, "z1.strain", repeat), campaign.geometry, calibration, model_source(identified)
    )
    assert all("redundancy" in flag for row in found.flags[1:] for flag in row)


def test_a_model_that_its_own_data_contradict_states_errors_that_cover(campaign, calibration, check):
    """The declared rig instead of the drawn one: intervals of 95 % hold the loads, and what is far off is flagged."""
    spectra = measured_spectra(campaign.runs, campaign.geometry)
    computed = identify(spectra, campaign.geometry, IdentifyOptions(method="computed"))
    assert computed.quality.chi2_per_dof > 100
    found = reduce_run(check, campaign.geometry, calibration, model_source(computed))
    cosine, sine = campaign.truths[check.name].harmonics(*found.interval)
    error = np.stack([found.amplitude.real - cosine, -found.amplitude.imag - sine])[:, 1:]
    sigma = np.stack([found.sigma_cosine, found.sigma_sine])[:, 1:]
    assert np.mean(np.abs(error) < 1.96 * sigma) > 0.9
    far = np.abs(error[0] + 1j * error[1]) > 0.3 * np.hypot(cosine, sine)[1:]
    flagged = np.array([["contradicted" in flag for flag in row] for row in found.flags[1:]])
    assert far.any()
    assert np.mean(flagged[far]) > 0.9


@pytest.mark.parametrize("torque_swept", [True, False])
def test_the_papers_form_states_errors_that_cover(campaign, check, torque_swept):
    """Its diagonal damping does not fit the rig: the misfit of sensors and torque alone widens the intervals enough."""
    geometry = campaign.geometry
    runs = [run for run in campaign.runs if torque_swept or run.excited != ("Mz",)]
    model = identify(measured_spectra(runs, geometry), geometry, IdentifyOptions(form="paper"))
    assert model.quality.chi2_per_dof > 1.2
    record = rotor_record(check, geometry, model_source(model))
    solution = harmonic_loads(record, geometry, model_source(model))
    cosine, sine = campaign.truths[check.name].harmonics(*record.spectra.interval)
    error = solution.loads - (cosine - 1j * sine)[1:, : solution.loads.shape[1]]

    def share_covered(covariance):
        sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        return np.mean(np.abs(np.concatenate([error.real, error.imag], axis=1)) < 1.96 * sigma)

    assert share_covered(solution.covariance + solution.model_covariance) > 0.9
    assert share_covered(solution.covariance) < 0.8
    without = model_source(replace(model, response_error=None))
    assert without.is_contradicted
    assert not model_source(model).is_contradicted


def test_the_error_of_a_misfit_does_not_need_redundancy(campaign, calibration, check):
    """With six sensors nothing tests the loads: the misfit seen in identification alone must widen the intervals."""
    spectra = measured_spectra(campaign.runs, campaign.geometry)
    computed = identify(spectra, campaign.geometry, IdentifyOptions(method="computed"))
    broken = check
    for name in [name for name in campaign.geometry.channel_names if name.startswith(("z4", "y2"))]:
        broken = with_channel(broken, name, np.zeros_like)
    found = reduce_run(broken, campaign.geometry, calibration, model_source(computed))
    cosine, sine = campaign.truths[check.name].harmonics(*found.interval)
    error = np.stack([found.amplitude.real - cosine, -found.amplitude.imag - sine])[:, 1:]
    sigma = np.stack([found.sigma_cosine, found.sigma_sine])[:, 1:]
    assert np.mean(np.abs(error) < 1.96 * sigma) > 0.9


def test_an_old_model_without_its_error_is_contradicted_as_a_whole(campaign, calibration, check):
    spectra = measured_spectra(campaign.runs, campaign.geometry)
    computed = identify(spectra, campaign.geometry, IdentifyOptions(method="computed"))
    old = replace(computed, response_error=None)
    found = reduce_run(check, campaign.geometry, calibration, model_source(old))
    assert all("model contradicted" in flag for row in found.flags[1:] for flag in row)


def test_a_filter_that_the_sweeps_contradict_flags_all_harmonics(campaign, calibration, identified, check):
    """Declared at half its cutoff it changes loads by up to 570 sigma; nothing in a wind run shows it."""
    geometry = campaign.geometry.model_dump(mode="json")
    geometry["acquisition"]["filter"]["cutoff"] = 100.0
    declared = Geometry.model_validate(geometry)
    findings = campaign_findings(declared, campaign.runs_of_kind("sweep"))
    responses = estimate_responses(campaign.runs, campaign.geometry)
    for source in (model_source(identified), transfer_source(responses, INTERPOLATIONS[0])):
        assert not source.is_contradicted
    doubted = transfer_source(keep_findings(responses, findings), INTERPOLATIONS[0])
    assert doubted.is_contradicted and doubted.at_spin(check.rotor_speed).is_contradicted
    source = model_source(keep_findings(identified, findings))
    found = reduce_run(check, campaign.geometry, calibration, source)
    assert all("model contradicted" in flag for row in found.flags[1:] for flag in row)
    assert not any("model contradicted" in flag for flag in found.flags[0])


@pytest.mark.parametrize(
    ("nis", "rms", "lasting", "samples", "contradicted"),
    [
        (0.96, 0.0, 0.0, 20000, False),
        (0.97, 0.018, 0.0, 24000, False),
        (1.02, 0.076, 0.0, 20666, False),  # a spectrum unlike that of the load model: the loads are right
        (1.0, 0.0, 0.0, 600, False),  # by chance 0.04 in so few samples
        (251.0, 0.0, 0.0, 20000, True),
        (0.5, 0.0, 0.0, 20000, True),
        (1.2, 0.2, 0.0, 20000, True),
        (0.98, 0.046, 0.1, 24000, True),  # a step of a load
    ],
)
def test_innovations_contradict_a_filter(
    campaign, calibration, identified, check, nis, rms, lasting, samples, contradicted
):
    rho = {"z1.piezo": lasting + rms * np.cos(2.0 * np.arange(1, 21)), "z2.piezo": np.zeros(20)}
    tests = InnovationTests(nis, 0.002, 1.0 + samples * rms**2, 0.08, {}, samples, rho, np.full(20, samples))
    assert tests.contradict_filter == contradicted
    marks = [cell.mark for cell in innovation_tests_row("wind-1", tests)]
    assert ("bad" in marks) == contradicted
    loads = reduce_run(check, campaign.geometry, calibration, model_source(identified))
    words = reduced_words(flag_filter(loads, tests))
    assert ("filter contradicted" in words) == contradicted
    assert flag_filter(loads, None) is loads


def test_a_lasting_correlation_has_slow_power():
    """1 + 2 sum w rho with the window of Bartlett, whose weights sum to half the number of lags."""
    tests = InnovationTests(1.0, 0.002, 1.0, 0.08, {}, 1000, {"a": np.full(20, 0.1), "b": np.zeros(20)})
    assert tests.slow_power == pytest.approx(1.0 + 2.0 * 0.1 * 10.0)
    assert InnovationTests(1.0, 0.002, 1.0, 0.08, {}, 1000).slow_power == 1.0


def test_without_any_usable_channel_the_reason_is_named(campaign, calibration, identified, check):
    run = replace(check, source=MemorySource(np.zeros_like(check.read().channels), check.read().loads))
    with pytest.raises(UserError, match=r"no channel is usable \(x\.strain: dead: constant at 0 V\)"):
        reduce_run(run, campaign.geometry, calibration, model_source(identified))


@pytest.mark.parametrize(("factor", "text"), [(1e-3, " 1000"), (-1.0, " -1"), (1.0, "")])
def test_check_loads_in_another_unit_or_reversed_are_named(campaign, calibration, identified, check, factor, text):
    block = check.read()
    source = MemorySource(block.channels, block.loads * factor)
    found = reduce_run(replace(check, source=source), campaign.geometry, calibration, model_source(identified))
    notes = [note for note in found.notes if "reduced loads over applied ones" in note]
    assert len(notes) == (1 if text else 0)
    if text:
        assert text in notes[0]
        assert all("model contradicted" in flag for row in found.flags for flag in row)


def swap_channels(run, first, second):
    block = run.read()
    channels = block.channels.copy()
    i, j = run.channel_names.index(first), run.channel_names.index(second)
    channels[:, [i, j]] = channels[:, [j, i]]
    return replace(run, source=MemorySource(channels, block.loads))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda run: with_channel(run, "z1.piezo", np.negative), "z1.piezo is reversed"),
        (lambda run: with_channel(run, "y1.piezo", lambda x: 2.0 * x), "y1.piezo reads 2"),
        (lambda run: swap_channels(run, "z1.piezo", "z2.piezo"), "z1.piezo and z2.piezo are exchanged"),
        (lambda run: run, ""),
    ],
)
def test_a_channel_that_contradicts_the_others_is_named(campaign, calibration, identified, check, change, text):
    found = reduce_run(change(check), campaign.geometry, calibration, model_source(identified))
    notes = [note for note in found.notes if "residual test is passed" in note]
    assert [text in note for note in notes] == ([True] if text else [])
