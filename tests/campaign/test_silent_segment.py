"""Channels that fall silent for a part of a record, with the noise of their amplifier, are left out or cut around."""

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.recording.silent_segment import silent_segments
from balance_cli.campaign.recording.sound_part import longest_sound_part
from balance_cli.steps.reduce import ReduceOptions, reduce_run
from tests.reduction.test_suspect_channels import computed
from tests.support.channels import with_channel
from tests.support.other_rigs import other_rig
from tests.support.wind_record import wind_record

NAMES = ("a", "b", "c", "d")
RATE, SPEED, SAMPLES = 500.0, 5.0, 10_000
TIME = np.arange(SAMPLES) / RATE


def record(change=lambda volts: volts, kind="wind"):
    """Four channels that oscillate with a rotor, and noise of a thousandth."""
    rng = np.random.default_rng(1)
    volts = np.cos(2 * np.pi * SPEED * TIME[:, None] + np.arange(4)) * [1.0, 0.3, 2.0, 0.01] + 0.5
    volts = change(volts) + 1e-3 * np.array([1.0, 0.3, 2.0, 0.01]) * rng.standard_normal(volts.shape)
    source = MemorySource(volts, None)
    return Run("wind", "R", kind, NAMES, SAMPLES, source, has_loads=False, sample_rate=RATE, rotor_speed=SPEED)


def silence(first, last, channels):
    def change(volts):
        volts[first:last, channels] = 0.0
        return volts

    return change


def gusts(volts):
    """The weakest channel has a load in one third of the record alone."""
    volts[:, 3] = np.where((TIME // 2.0) % 3 == 0, np.cos(40.0 * TIME) * np.abs(np.sin(np.pi * TIME / 2.0)), 0.0)
    return volts


@pytest.mark.parametrize(("first", "last"), [(3000, 5000), (0, 1000), (6000, SAMPLES), (2050, 2450)])
def test_a_channel_with_noise_alone_is_found_with_its_ends(first, last):
    begin, end = silent_segments(record(silence(first, last, [1])), NAMES)["b"]
    assert first - 200 <= begin <= first and last - 1 <= end <= last + 199


@pytest.mark.parametrize(
    "change", [silence(0, 0, [1]), silence(3000, 5000, [0, 1, 2, 3]), silence(3000, 3150, [1]), gusts]
)
def test_sound_records_have_none(change):
    """Nor one in which all channels are quiet, or one for a revolution, or one that gusts reach now and then."""
    assert not silent_segments(record(change), NAMES)


def test_records_without_a_rotor_are_not_judged():
    assert not silent_segments(record(silence(3000, 5000, [1]), "sweep"), NAMES)


def test_the_longest_part_beside_it_is_sound():
    part = longest_sound_part(record(silence(3000, 5000, [1])), ["b"])
    assert part is not None and 5000 <= part.start <= 5200 and part.stop == SAMPLES
    assert longest_sound_part(record(silence(3000, 5000, [1])), ["a"]) is None


def test_loads_rest_on_the_other_channels():
    """All loads of such a run were flagged: the channel seemed to read 0.8 times what the others say."""
    geometry, source = computed(other_rig("B"))
    loads = np.array([[30.0, 20.0, 200.0, 3.0, 4.0, 2.0], *[[20.0, 15j, 30.0, 3j, 4.0, 2.0]] * 4], complex)

    def unplug(samples):
        quiet = 1e-4 * np.ptp(samples) * np.random.default_rng(2).standard_normal(len(samples))
        return np.where((samples * 0 + np.arange(len(samples))) // 800 == 2, quiet, samples)

    run = with_channel(wind_record(geometry, loads, seconds=4.0).run, "ax.piezo", unplug)
    result = reduce_run(run, geometry, None, source, None, ReduceOptions(harmonics=4))
    assert result.left_out["ax.piezo"].startswith("dead for part of the record: noise alone from sample ")
    assert not any("redundancy" in words or "not steady" in words for row in result.flags for words in row)
    error = result.amplitude[1:] - loads[1:]
    assert np.all(np.abs(error.real) < 4.5 * result.sigma_cosine[1:])
