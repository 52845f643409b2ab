"""A channel that the loads need is lost for a second: the longest part of the record without that is reduced."""

import numpy as np
import pytest

from balance_cli.io.errors import UserError
from balance_cli.reduction.model_sources import model_source
from balance_cli.steps.reduce import reduce_run
from balance_cli.steps.reduce_sound_part import reduce_sound_part
from tests.support.channels import with_channel


def lost(first, count, value):
    def change(x):
        x = x.copy()
        x[first : first + count] = x[first] if value == "stuck" else value
        return x

    return change


def reduce_run_or_part(run, *rig):
    try:
        return reduce_run(run, *rig)
    except UserError as error:
        return reduce_sound_part(error, run, *rig)


@pytest.fixture(scope="module")
def rig(campaign, calibration, identified):
    return campaign.geometry, calibration, model_source(identified)


@pytest.fixture(scope="module")
def wind(campaign):
    return campaign.runs_of_kind("wind")[0]


@pytest.mark.parametrize("value", [np.nan, 0.0, "stuck"])
@pytest.mark.parametrize("share", [0.2, 0.8])
def test_loads_of_the_part_before_or_after_it_are_right(campaign, rig, wind, value, share):
    """Half a second of the torque meter, which alone tells Mz, had the whole run refused."""
    first, count = int(share * wind.samples), int(0.5 * wind.sample_rate)
    broken = with_channel(wind, "torque", lost(first, count, value))
    with pytest.raises(UserError, match="do not determine"):
        reduce_run(broken, *rig)
    loads = reduce_run_or_part(broken, *rig)
    begin, end = np.array(loads.interval) * wind.sample_rate
    assert end <= first if share > 0.5 else begin >= first + count
    assert any("torque is lost" in note for note in loads.notes) and not loads.left_out
    cosine, sine = campaign.truths[wind.name].harmonics(*loads.interval)
    # The azimuth of the truth counts from the same pulses, whichever of them are used.
    error = np.abs(loads.amplitude - (cosine - 1j * sine))[1:]
    assert np.all(error < 5.0 * np.hypot(loads.sigma_cosine, loads.sigma_sine)[1:])


def test_sound_runs_and_channels_that_are_faulty_throughout_are_as_before(rig, wind):
    whole, again = reduce_run(wind, *rig), reduce_run_or_part(wind, *rig)
    assert np.array_equal(whole.amplitude, again.amplitude) and whole.notes == again.notes
    with pytest.raises(UserError, match="do not determine"):
        reduce_run_or_part(with_channel(wind, "torque", np.zeros_like), *rig)
    redundant = reduce_run_or_part(with_channel(wind, "z3.piezo", lost(4000, 400, np.nan)), *rig)
    assert list(redundant.left_out) == ["z3.piezo"] and not any("lost" in note for note in redundant.notes)
