"""Reduction of simulated runs whose hub loads are known."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource
from balance_cli.estimation.identified_model import CONTRADICTS_OTHERS
from balance_cli.io.errors import UserError
from balance_cli.reduction.history_file import harmonic_history
from balance_cli.reduction.model_sources import model_source
from balance_cli.reduction.response_sources import static_source
from balance_cli.reduction.result import LOAD_TABLE_COLUMNS, HubLoads, load_table
from balance_cli.steps.reduce import ReduceOptions, reduce_run
from tests.support.channels import with_channel
from tests.support.truth_source import TruthSource


@pytest.fixture(scope="module")
def check(campaign):
    return campaign.runs_of_kind("check")[0]


@pytest.fixture(scope="module")
def reduced(campaign, calibration, identified, check):
    return reduce_run(check, campaign.geometry, calibration, model_source(identified))


def truth_of(campaign, run, reduced):
    return campaign.truths[run.name].harmonics(*reduced.interval)


def test_harmonics_are_the_true_hub_loads_within_sigma(campaign, check, reduced):
    cosine, sine = truth_of(campaign, check, reduced)
    error = np.concatenate(
        [
            (reduced.amplitude.real - cosine)[1:] / reduced.sigma_cosine[1:],
            (-reduced.amplitude.imag - sine)[1:] / reduced.sigma_sine[1:],
        ]
    )
    assert np.sqrt(np.mean(error**2)) == pytest.approx(1.0, abs=0.35)
    assert np.abs(error).max() < 5.0


def test_errors_are_little_more_than_the_true_response_would_leave(campaign, calibration, check, reduced):
    best = reduce_run(check, campaign.geometry, calibration, TruthSource(campaign.rig, 2.0))
    for name, value in reduced.check.load_error.items():
        assert value < 1.3 * max(best.check.load_error[name], reduced.check.load_noise[name])
        assert value < 0.02


def test_the_redundant_channels_agree(reduced):
    assert np.all(reduced.redundancy[1:] < 2.5)
    expected = tuple("untested" if name == "Mz" else "" for name in reduced.components)
    assert all(flags == expected for flags in reduced.flags[1:])


def test_the_residual_test_rejects_the_static_matrix(campaign, calibration, check):
    static = reduce_run(check, campaign.geometry, calibration, static_source(calibration))
    assert max(static.check.load_error.values()) > 0.1
    assert any("redundancy" in flags[0] for flags in static.flags[1:])


def test_mean_loads_of_a_wind_run(campaign, calibration, identified):
    wind = campaign.runs_of_kind("wind")[0]
    found = reduce_run(wind, campaign.geometry, calibration, model_source(identified))
    cosine, _ = truth_of(campaign, wind, found)
    error = (found.amplitude[0].real - cosine[0]) / found.sigma_cosine[0]
    assert np.abs(error).max() < 5.0
    assert all("no zero" in flag for flag in found.flags[0])
    assert found.trim in ("bare", "trim")


def test_a_dead_channel_is_left_out_and_the_loads_stay_right(campaign, calibration, identified, check, reduced):
    broken = with_channel(check, "z3.piezo", lambda x: np.zeros_like(x))
    found = reduce_run(broken, campaign.geometry, calibration, model_source(identified))
    assert list(found.left_out) == ["z3.piezo"]
    apart = np.abs(found.amplitude[1:] - reduced.amplitude[1:])
    assert np.all(apart < 5 * (found.sigma_cosine[1:] + reduced.sigma_cosine[1:]))


@pytest.mark.parametrize(
    "change", [lambda x: np.clip(x, -0.05, 0.05), lambda x: np.where(np.arange(len(x)) == 99, np.nan, x)]
)
def test_a_clipped_or_non_finite_channel_is_left_out(campaign, calibration, identified, check, change):
    broken = with_channel(check, "z1.piezo", change)
    found = reduce_run(broken, campaign.geometry, calibration, model_source(identified))
    assert list(found.left_out) == ["z1.piezo"]


def test_a_channel_that_a_diagnosis_left_out_of_the_fit_is_left_out_here_too(
    campaign, calibration, identified, check, reduced
):
    """A reading that saturates softly, and passes every test of the samples, moves no load."""
    run = with_channel(check, "z1.piezo", lambda v: v - 0.2 * v**3 / np.max(v**2))
    everywhere = {run.name: {"z1.piezo": CONTRADICTS_OTHERS} for run in campaign.runs}
    judged = replace(identified, channels_left_out=everywhere)
    lost = reduce_run(run, campaign.geometry, calibration, model_source(judged))
    assert lost.left_out == {"z1.piezo": CONTRADICTS_OTHERS}
    used = reduce_run(run, campaign.geometry, calibration, model_source(identified))
    error, harm = (np.abs(each.amplitude - reduced.amplitude)[1:].max() for each in (lost, used))
    assert error < 0.1 * harm


def test_loads_that_the_remaining_channels_do_not_determine_are_refused(campaign, calibration, identified, check):
    broken = with_channel(check, "torque", np.zeros_like)
    with pytest.raises(UserError, match="do not determine") as error:
        reduce_run(broken, campaign.geometry, calibration, model_source(identified))
    assert "torque" in str(error.value)


def test_a_run_without_pulses_is_refused(campaign, calibration, identified, check):
    with pytest.raises(UserError, match="no 1/rev pulses"):
        reduce_run(replace(check, pulse_times=None), campaign.geometry, calibration, model_source(identified))


def test_the_table_has_one_row_per_component_and_harmonic(campaign, calibration, identified, check):
    options = ReduceOptions(harmonics=5)
    run = reduce_run(check, campaign.geometry, calibration, model_source(identified), options=options)
    table = load_table(HubLoads("harmonic", "model", campaign.geometry, {run.run: run}))
    assert tuple(table.columns) == LOAD_TABLE_COLUMNS
    assert len(table) == 6 * 6
    row = table[(table.component == "Mx") & (table.harmonic == 3)].iloc[0]
    assert row.unit == "N m"
    assert row.amplitude == pytest.approx(np.hypot(row.cosine, row.sine))
    angle = np.radians(row.phase_deg)
    assert row.cosine == pytest.approx(row.amplitude * np.cos(angle))
    assert row.sine == pytest.approx(-row.amplitude * np.sin(angle))


def test_a_history_is_the_sum_of_the_harmonics(check, reduced, campaign):
    blocks = tuple(harmonic_history(check, reduced))
    time, loads, sigma = (np.concatenate([getattr(one, name) for one in blocks]) for name in ("time", "loads", "sigma"))
    truth = campaign.truths[check.name]
    every = truth.time[(truth.time >= reduced.interval[0]) & (truth.time < reduced.interval[1])]
    np.testing.assert_array_equal(time, every)
    at = np.searchsorted(truth.time, time[0])
    true = truth.loads[at : at + len(time)]
    applied = [i for i in range(6) if np.any(true[:, i])]
    error = (loads - true)[:, applied] - (loads - true)[:, applied].mean(axis=0)
    assert np.all(error.std(axis=0) < 0.03 * true[:, applied].std(axis=0) + 1e-9)
    assert np.all(sigma > 0)


def with_samples(run, channels, loads):
    return replace(run, samples=len(channels), source=MemorySource(channels, loads))


def test_lost_samples_are_no_steady_loads(campaign, calibration, identified, check):
    """From where three samples were lost, the pulses turn all loads: without a word before."""
    block, lost = check.read(0), slice(3 * check.samples // 4, 3 * check.samples // 4 + 3)
    run = with_samples(check, np.delete(block.channels, lost, axis=0), np.delete(block.loads, lost, axis=0))
    loads = reduce_run(run, campaign.geometry, calibration, model_source(identified))
    assert all("not steady" in flag for flags in loads.flags for flag in flags)
    assert any("samples lost" in note for note in loads.notes)


def test_pulses_after_the_end_of_the_record_are_left_out(campaign, calibration, identified, check):
    """A pulse a few samples behind the record was an internal error."""
    block = check.read(0)
    last = int(check.pulse_times[-1] * check.sample_rate) - 3
    run = with_samples(check, block.channels[:last], block.loads[:last])
    loads = reduce_run(run, campaign.geometry, calibration, model_source(identified))
    assert loads.interval[1] <= last / check.sample_rate
    assert any("1 pulse after the end of the record" in note for note in loads.notes)
