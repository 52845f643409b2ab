"""A channel that changes within a record of a rig without redundancy, and a response that most harmonics reject."""

import numpy as np
import pytest
from scipy.signal import butter, sosfilt

from balance_cli.campaign.recording.run import MemorySource
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.reduction.flags import NOT_STEADY, REDUNDANCY
from balance_cli.reduction.model_sources import ModelSource
from balance_cli.signals.rotor.azimuth import azimuth_from_pulses
from balance_cli.signals.rotor.channel_change import relative_changes
from balance_cli.signals.rotor.common_turn import common_turn
from balance_cli.signals.rotor.steadiness import windowed_amplitudes
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


@pytest.mark.parametrize(("seed", "share"), [(8, 0.3), (5, 1.0)])
def test_gusts_that_shake_all_channels_for_a_dozen_revolutions_are_no_turn(seed, share):
    rng = np.random.default_rng(seed)
    loads = SIZE * (rng.standard_normal((9, 6)) + 1j * rng.standard_normal((9, 6)))
    loads /= np.maximum(np.arange(9), 1)[:, None] ** 1.5
    seconds = 13.2 / RIG.rotor.speed
    white = rng.standard_normal((int((seconds + 10.5) * 800), 6))
    gusts = sosfilt(butter(1, 100.0, fs=800.0, output="sos"), white, axis=0)
    gusts *= share * SIZE / gusts.std(axis=0)
    run = wind_record(
        RIG, loads, rate=800.0, seconds=seconds, noise=1e-3, seed=seed, further=lambda time, psi: gusts[: len(time)]
    ).run
    azimuth = azimuth_from_pulses(run.pulse_times)
    values = windowed_amplitudes(run, azimuth, run.channel_names, 8, (0, azimuth.turns)).values[:, 1:]
    sigma = values.std(axis=0) * np.sqrt(2.0 / len(values))
    assert common_turn(values, relative_changes(values).weight, sigma) is None
