"""The two channels of a cell must agree in a wind run, whatever its loads are."""

import numpy as np
import pytest

from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.reduction.model_sources import model_source
from balance_cli.simulation import draw_rig, simulate_campaign
from balance_cli.steps.identify import IdentifyOptions, identify
from balance_cli.steps.reduce import reduce_run
from tests.reduction.test_speed_modulation import EXACT, RIG, flags, governor
from tests.support.channels import with_channel
from tests.support.other_rigs import other_rig, short_campaign


def late(volts):
    """One sample late."""
    frequency = np.fft.rfftfreq(len(volts))
    return np.fft.irfft(np.fft.rfft(volts) * np.exp(-2j * np.pi * frequency), len(volts))


def words(loads):
    return {word for row in loads.flags for flag in row for word in flag.split("; ") if word}


@pytest.mark.parametrize("change", [lambda volts: 1.15 * volts, late, np.negative])
def test_a_channel_that_changed_after_the_sweeps_flags_the_run(campaign, calibration, identified, change):
    wind = campaign.runs_of_kind("wind")[0]
    found = reduce_run(with_channel(wind, "z2.piezo", change), campaign.geometry, calibration, model_source(identified))
    assert all("redundancy" in flag for row in found.flags for flag in row)
    assert any("z2.strain and z2.piezo read one cell" in note for note in found.notes)


def test_sound_channels_agree(campaign, calibration, identified):
    for wind in campaign.runs_of_kind("wind"):
        found = reduce_run(wind, campaign.geometry, calibration, model_source(identified))
        assert "redundancy" not in words(found) and not any("read one cell" in note for note in found.notes)


def test_volts_that_are_millivolts_make_loads_that_no_balance_bears(campaign, calibration, identified):
    wind = campaign.runs_of_kind("wind")[0]
    for name in wind.channel_names:
        wind = with_channel(wind, name, lambda volts: 1e3 * volts)
    found = reduce_run(wind, campaign.geometry, calibration, model_source(identified))
    assert all("extrapolated" in flag for row in found.flags for flag in row)
    assert any("times the calibrated range" in note for note in found.notes)


@pytest.fixture(scope="module")
def short_record():
    """A wind record of 60 revolutions of rig D, its loads, and the rig with the response as it is."""
    exact = other_rig("D")
    exact = exact.model_copy(update={"tolerances": exact.tolerances.model_copy(update=EXACT)})
    source = model_source(identify(Spectra((), (), {}, {}), exact, IdentifyOptions(method="computed")))
    plan = short_campaign("D", revolutions=60)
    plan = plan.model_copy(update={"runs": tuple(run for run in plan.runs if run.run == "wind-1")})
    simulated = simulate_campaign(draw_rig(exact, np.random.default_rng(1)), plan, seed=1)
    return simulated.runs[0], simulated.truths[0], exact, source


@pytest.mark.parametrize("channel", ["x.piezo", "y1.piezo", "z2.strain"])
def test_a_gain_that_drifts_a_little_is_in_sigma_and_said(short_record, channel):
    """Of one channel, by 3 %: loads had been up to 19, 72 and 2 standard deviations off."""
    run, truth, geometry, source = short_record

    def drifting(volts):
        return volts * (1.0 + 0.03 * np.linspace(0.0, 1.0, len(volts)))

    loads = reduce_run(with_channel(run, channel, drifting), geometry, None, source)
    error = loads.amplitude - (truth.cosine - 1j * truth.sine)[: len(loads.amplitude)]
    sigmas = np.maximum(np.abs(error.real) / loads.sigma_cosine, np.abs(error.imag) / loads.sigma_sine)[1:]
    assert np.all(sigmas < 3.5)
    cell = channel.partition(".")[0]
    assert sum(f"{cell}.strain and {cell}.piezo read one cell" in note for note in loads.notes) == 1
    assert all("not steady" in flag for row in loads.flags for flag in row)


def test_a_sound_short_record_has_no_gain(short_record):
    run, _, geometry, source = short_record
    loads = reduce_run(run, geometry, None, source)
    assert not words(loads) - {"untested", "not measured"} and not any("read one cell" in note for note in loads.notes)


@pytest.mark.parametrize("change", [governor, lambda time: 0.1 * (time / 14.0 - 0.5)])
def test_a_speed_that_drifts_is_no_gain(change):
    source = model_source(identify(Spectra((), (), (), {}), RIG, IdentifyOptions(method="computed")))
    _, loads = flags(source, speed_change=change)
    assert not any("read one cell" in note for note in loads.notes)
