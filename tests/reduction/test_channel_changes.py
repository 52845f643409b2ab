"""A channel that changes within a record of a rig without redundancy, and a response that most harmonics reject."""

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.reduction.flags import NOT_STEADY, REDUNDANCY
from balance_cli.reduction.model_sources import ModelSource
from balance_cli.steps.identify import IdentifyOptions, identify
from balance_cli.steps.reduce import reduce_run
from tests.reduction.test_speed_modulation import EXACT, RIG, SIZE
from tests.support.other_rigs import other_rig
from tests.support.wind_record import wind_record

SIX_CELLS = other_rig("A")


def reduced(geometry, channel, edit):
    """Loads of a record in which the samples of one channel are edited."""
    source = ModelSource(identify(Spectra((), (), (), {}), geometry, IdentifyOptions(method="computed")))
    rng = np.random.default_rng(5)
    loads = SIZE * (rng.standard_normal((9, 6)) + 1j * rng.standard_normal((9, 6)))
    record = wind_record(geometry, loads, rate=800.0, seconds=8.0, noise=1e-3)
    volts = record.run.read().channels.copy()
    column = record.run.channel_names.index(channel)
    volts[:, column] = edit(volts[:, column], np.arange(len(volts)) / 800.0)
    run = record.run.__class__(**{**vars(record.run), "source": MemorySource(volts, None)})
    return reduce_run(run, geometry, None, source)


@pytest.fixture(scope="module")
def one_channel_per_cell():
    channels = tuple(channel for channel in SIX_CELLS.channels if "piezo" in channel.name)
    tolerances = SIX_CELLS.tolerances.model_copy(update=EXACT)
    return SIX_CELLS.model_copy(update={"channels": channels, "tolerances": tolerances})


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (lambda x, t: np.where(t < 4.0, x, 1.2 * x), "harmonics of l3.piezo have 1.2 times their size"),
        (lambda x, t: np.where(t < 5.0, x, 1e-3 * np.sin(1e4 * t)), "harmonics of l3.piezo have"),
    ],
    ids=["gain is switched", "cable comes off"],
)
def test_a_channel_that_changes_makes_all_loads_unsteady(one_channel_per_cell, edit, said):
    loads = reduced(one_channel_per_cell, "l3.piezo", edit)
    assert all(NOT_STEADY in flag for row in loads.flags for flag in row)
    assert any(said in note for note in loads.notes)


def test_a_steady_record_is_not_flagged(one_channel_per_cell):
    loads = reduced(one_channel_per_cell, "l3.piezo", lambda x, t: x)
    assert not any(NOT_STEADY in flag for row in loads.flags for flag in row)


def test_a_response_that_most_harmonics_reject_is_rejected_at_all():
    loads = reduced(RIG, "x.piezo", lambda x, t: 1.003 * x)
    by_test = loads.redundancy[1:] > loads.redundancy_limit[1:]
    assert 3 <= np.count_nonzero(by_test) < 8
    assert all(REDUNDANCY in flag for row in loads.flags[1:] for flag in row)
