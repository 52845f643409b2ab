"""What is wrong with a channel in a wind run alone is named by the residuals: no load is known."""

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.reduction.model_sources import ModelSource, model_source
from balance_cli.steps.contradicted_loads import compare_with_other_runs
from balance_cli.steps.identify import IdentifyOptions, identify
from balance_cli.steps.reduce import reduce_run
from tests.reduction.test_channel_pairs import late
from tests.reduction.test_speed_modulation import EXACT, RIG, SIZE
from tests.support.channels import with_channel
from tests.support.other_rigs import other_rig
from tests.support.wind_record import wind_record

HEXAPOD = other_rig("A")


def swap_channels(run, first, second):
    """The run with two channels in each other's place."""
    volts = run.read().channels.copy()
    i, j = run.channel_names.index(first), run.channel_names.index(second)
    volts[:, [i, j]] = volts[:, [j, i]]
    return run.__class__(**{**vars(run), "source": MemorySource(volts, None)})


@pytest.mark.parametrize(
    ("spoil", "name"),
    [
        (lambda run: swap_channels(run, "y1.piezo", "z1.piezo"), "y1.piezo and z1.piezo are exchanged"),
        (lambda run: swap_channels(run, "z2.strain", "z4.strain"), "z2.strain and z4.strain are exchanged"),
        (lambda run: swap_channels(run, "z3.strain", "z3.piezo"), "z3.strain and z3.piezo are exchanged"),
        (lambda run: with_channel(run, "z2.strain", np.negative), "z2.strain is reversed"),
        (lambda run: with_channel(run, "y2.piezo", lambda x: 2.0 * x), "y2.piezo reads 2 times"),
    ],
)
def test_a_mistake_in_a_wind_run_alone_is_named(campaign, calibration, identified, spoil, name):
    wind = campaign.runs_of_kind("wind")[0]
    loads = reduce_run(spoil(wind), campaign.geometry, calibration, model_source(identified))
    assert loads.wrong_channels is not None and loads.wrong_channels.startswith(name)
    assert any(loads.wrong_channels in note for note in loads.notes)
    assert all("redundancy" in flag for row in loads.flags for flag in row)
    assert f"{loads.wrong_channels} in {wind.name}" in compare_with_other_runs({wind.name: loads})[1]


def test_sound_channels_are_not_named(campaign, calibration, identified):
    for wind in campaign.runs_of_kind("wind"):
        assert reduce_run(wind, campaign.geometry, calibration, model_source(identified)).wrong_channels is None


def computed(geometry):
    """The rig with exact tolerances, and its response."""
    exact = geometry.model_copy(update={"tolerances": geometry.tolerances.model_copy(update=EXACT)})
    return exact, ModelSource(identify(Spectra((), (), (), {}), exact, IdentifyOptions(method="computed")))


def gusty_record(geometry, seconds):
    """A record with gusts of a third of the loads."""
    rng = np.random.default_rng(5)
    loads = SIZE * (rng.standard_normal((9, 6)) + 1j * rng.standard_normal((9, 6)))
    gusts = 0.3 * SIZE * rng.standard_normal((20_000, 6))
    return wind_record(
        geometry, loads, rate=800.0, seconds=seconds, noise=1e-3, further=lambda time, psi: gusts[: len(time)]
    ).run


def test_two_channels_of_a_cell_that_nothing_else_tests_are_both_named():
    geometry, source = computed(HEXAPOD)
    run = with_channel(gusty_record(geometry, 4.0), "l3.piezo", np.negative)
    said = reduce_run(run, geometry, None, source).wrong_channels
    assert said is not None and sorted(said.split(", or ")) == ["l3.piezo is reversed", "l3.strain is reversed"]


def test_gusts_of_a_short_record_do_not_hide_half_a_gain():
    geometry, source = computed(RIG)
    piezo = tuple(channel for channel in geometry.channels if "strain" not in channel.name)
    geometry = geometry.model_copy(update={"channels": piezo})
    source = computed(geometry)[1]
    run = gusty_record(geometry, 0.75)
    assert reduce_run(run, geometry, None, source).wrong_channels is None
    loads = reduce_run(with_channel(run, "z1.piezo", lambda x: 0.5 * x), geometry, None, source)
    assert loads.wrong_channels == "z1.piezo reads 0.5 times what the other channels say"
    assert all("redundancy" in flag for row in loads.flags for flag in row)


def test_a_late_channel_is_no_factor(campaign, calibration, identified):
    wind = with_channel(campaign.runs_of_kind("wind")[0], "z2.piezo", late)
    loads = reduce_run(wind, campaign.geometry, calibration, model_source(identified))
    assert loads.wrong_channels is None
    assert any("z2.piezo contradict the other channels" in note for note in loads.notes)
