"""The two channels of a cell must agree in a wind run, whatever its loads are."""

import numpy as np
import pytest

from balance_cli.reduction.model_sources import model_source
from balance_cli.steps.reduce import reduce_run
from tests.support.channels import with_channel


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
