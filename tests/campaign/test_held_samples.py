"""Samples that repeat the one before, or are zeros of a link that dropped out, are bridged like missing ones."""

import tracemalloc
from dataclasses import dataclass, replace

import numpy as np
import pytest

from balance_cli.campaign.recording.channel_health import channel_faults
from balance_cli.campaign.recording.false_samples import repeated_block
from balance_cli.campaign.recording.gaps import bridge_gaps, describe_gaps
from balance_cli.campaign.recording.held_samples import held_samples
from balance_cli.campaign.recording.run import MemorySource, Run, SampleBlock
from tests.campaign.test_gaps import rotor_run

PLACES = np.array([1003, 2511, 4805, 7707])


def changed(change, seed=0, **of_run) -> Run:
    """The first channel changed by a function of its samples."""
    run = rotor_run(seed)
    channels = run.read().channels.copy()
    channels[:, 0] = change(channels[:, 0])
    return replace(run, source=MemorySource(channels, None), **of_run)


def dropped(length, value=None, places=PLACES):
    """Segments of a value, or of the sample before each."""

    def change(x):
        for place in places:
            x[place : place + length] = x[place] if value is None else value
        return x

    return change


def index_of(length, held=False, places=PLACES):
    return np.concatenate([np.arange(place + held, place + length) for place in places])


@pytest.mark.parametrize("mean", [0.0, 5.0])
@pytest.mark.parametrize("length", [5, 20, 32])
@pytest.mark.parametrize("value", [None, 0.0])
def test_segments_that_are_held_or_zero_are_found(length, value, mean):
    run = changed(lambda x: dropped(length, value)(x + mean))
    found = held_samples(run)
    assert list(found) == [0]
    np.testing.assert_array_equal(found[0], index_of(length, held=value is None))


@pytest.mark.parametrize("mean", [0.0, 5.0])
@pytest.mark.parametrize("value", [None, 0.0])
def test_single_samples_that_are_often_held_or_zero_are_found(value, mean):
    places = np.random.default_rng(1).choice(np.arange(50, 9500), 40, replace=False)
    run = changed(lambda x: dropped(1 if value == 0.0 else 2, value, places)(x + mean))
    found = held_samples(run)[0]
    assert np.isin(places if value == 0.0 else places + 1, found).all()
    assert len(found) <= 42


@pytest.mark.parametrize("step", [0.5, 0.1, 0.02, 0.003])
@pytest.mark.parametrize("noise", [0.0, 0.01, 0.1])
@pytest.mark.parametrize("stored", [np.float32, float])
def test_a_coarse_converter_holds_nothing(step, noise, stored):
    run = rotor_run(2, noise=noise)
    samples = (np.round(run.read().channels / step) * step).astype(stored).astype(float)
    assert held_samples(replace(run, source=MemorySource(samples, None))) == {}


def test_a_slow_signal_without_noise_holds_nothing():
    time = np.arange(60_000) / 51_200.0
    slow = np.cos(2 * np.pi * 4.0 * time) + 0.2 * np.cos(2 * np.pi * 12.0 * time)
    for samples in (slow.astype(np.float32).astype(float), np.round(slow * 200) / 200, np.round(slow * 8000) / 8000):
        run = replace(rotor_run(0), samples=len(samples), source=MemorySource(samples[:, None], None))
        assert held_samples(replace(run, channel_names=("a",))) == {}


def test_clipped_samples_are_left_to_their_own_test():
    run = changed(lambda x: np.minimum(x, np.quantile(x, 0.95)))
    assert held_samples(run) == {}
    assert "clipped" in channel_faults(run, {"a": None})["a"]


def test_a_channel_that_was_read_at_a_lower_rate_is_left_out():
    run = changed(lambda x: np.repeat(x[::4], 4)[: len(x)])
    assert len(held_samples(run)[0]) > 0.7 * run.samples
    assert "repeat the one before" in channel_faults(bridge_gaps(run), {"a": None})["a"]


def test_a_channel_may_rest_between_blows_of_a_hammer():
    blow = np.where(np.arange(9600) % 2400 < 600, np.exp(-(np.arange(9600) % 2400) / 60.0), 0.0)
    run = changed(lambda x: np.round(50 * blow * x) / 50, excitation="impact", kind="sweep")
    assert held_samples(run) == {}


def test_what_is_held_is_bridged_and_said():
    run, sound = changed(dropped(20, 0.0)), rotor_run(0)
    filled = bridge_gaps(run)
    assert describe_gaps(filled) == (
        "missing samples interpolated: a (80 in 4 gaps, longest 20; 80 of them repeat a value or are exactly zero)"
    )
    assert channel_faults(filled, {"a": None}) == {}
    error = filled.read().channels[:, 0] - sound.read().channels[:, 0]
    assert np.sqrt(np.mean(error[index_of(20)] ** 2)) < 0.2
    np.testing.assert_array_equal(np.flatnonzero(error), index_of(20))


def test_a_channel_that_is_often_held_is_left_out():
    places = np.arange(100, 9400, 150)
    run = bridge_gaps(changed(dropped(10, 0.0, places)))
    assert channel_faults(run, {"a": None}) == {
        "a": "held or dropped out: 620 of 9600 samples repeat the one before or are exactly zero, the first is sample "
        "100, more than can be bridged"
    }


@pytest.mark.parametrize("length", [16, 256])
@pytest.mark.parametrize("lag", [256, 1000])
def test_a_buffer_that_was_written_twice_is_refused(length, lag):
    run = rotor_run(0)
    channels = run.read().channels.copy()
    channels[5000 : 5000 + length] = channels[5000 - lag : 5000 - lag + length]
    faults = channel_faults(bridge_gaps(replace(run, source=MemorySource(channels, None))), dict.fromkeys("abc"))
    said = f"samples 5000 to {4999 + length} repeat earlier ones in all channels: was a buffer written twice?"
    assert faults == dict.fromkeys("abc", said)


def test_records_without_noise_and_coarse_ones_repeat_no_block():
    run = rotor_run(0)
    periodic = np.tile(run.read().channels[:96], (100, 1))
    assert len(repeated_block(replace(run, source=MemorySource(periodic, None)))) == 0
    for step in (0.5, 0.1, 0.02):
        coarse = np.round(run.read().channels / step) * step
        assert len(repeated_block(replace(run, source=MemorySource(coarse, None)))) == 0


def test_a_signal_that_dwells_at_a_flat_crest_by_chance_holds_nothing():
    """Noise of three steps of the converter repeats values there, and hardly elsewhere."""
    psi = 2 * np.pi * np.arange(9600) / 96
    flat_topped = 3000 * (np.cos(psi) - np.cos(3 * psi) / 9)
    for seed in range(12):
        samples = np.round(flat_topped + 3 * np.random.default_rng(seed).standard_normal(len(psi)))
        crest = 96 * (5 + 7 * seed)
        samples[crest - 3 : crest + 4] = np.round(flat_topped[crest])
        assert 0 not in held_samples(changed(lambda _, samples=samples: samples))
        samples[crest + 24 : crest + 32] = np.round(flat_topped[crest + 28])
        run = changed(lambda _, samples=samples: samples)
        np.testing.assert_array_equal(held_samples(run)[0], np.arange(crest + 25, crest + 32))


@dataclass(frozen=True)
class Recorded:
    """Samples that are in memory only while they are read: noise, the same again where it is read again."""

    samples: int
    columns: int

    def read(self, start, stop):
        stop = self.samples if stop is None else min(stop, self.samples)
        channels = np.random.default_rng(start).random((stop - start, self.columns))
        channels[100:110, 0] = channels[100, 0]
        return SampleBlock(start, channels, None)


def test_a_long_record_is_not_kept_in_memory():
    """The blocks of a record of ten minutes, 2.2 GB, were kept while one of its channels was examined."""
    run, columns = rotor_run(0), 20
    source = Recorded(2**20, columns)
    names = tuple(f"c{i}" for i in range(columns))
    run = replace(run, channel_names=names, samples=source.samples, source=source)
    tracemalloc.start()
    held = held_samples(run)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(held[0]) >= 9
    assert peak < 0.4 * 8 * source.samples * columns
