"""Short gaps are interpolated where a record is read, and the error that they leave is stated."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
from scipy import signal

from balance_cli.campaign.recording.channel_health import channel_faults
from balance_cli.campaign.recording.gaps import LONGEST_GAP, bridge_gaps, describe_gaps, gap_summary
from balance_cli.campaign.recording.run import MemorySource, Run, excerpt_run, run_digest
from balance_cli.campaign.recording.run_checks import load_sample_faults
from balance_cli.campaign.recording.run_file import open_run, write_run
from balance_cli.signals.rotor.azimuth import azimuth_from_pulses
from balance_cli.signals.rotor.harmonics import estimate_harmonics

RATE, SPEED, SECONDS = 800.0, 17.3, 12.0


def rotor_run(seed: int, noise: float = 0.01, resonance: float = 0.3, hiss: float = 0.0) -> Run:
    """Three channels of rotor harmonics, random motion of a light resonance, and noise; amplitudes are 1.

    `hiss`: noise above 150 Hz, which nothing predicts.
    """
    rng = np.random.default_rng(seed)
    n = int(SECONDS * RATE)
    time = np.arange(n) / RATE
    psi = 2 * np.pi * SPEED * time
    periodic = sum(np.cos(k * psi + k) for k in range(1, 5))
    r = np.exp(-0.02 * 2 * np.pi * 41.0 / RATE)
    shaken = signal.lfilter([1.0], [1, -2 * r * np.cos(2 * np.pi * 41.0 / RATE), r * r], rng.standard_normal(n + 500))
    high = signal.sosfilt(signal.butter(8, 150.0, "high", fs=RATE, output="sos"), rng.standard_normal(n + 500))
    shaken = resonance * shaken[500:] / shaken.std() + hiss * high[500:]
    channels = np.stack([g * (periodic + shaken) for g in (1.0, 0.5, -0.7)], 1) + noise * rng.standard_normal((n, 3))
    pulses = np.arange(0, SECONDS, 1 / SPEED)
    return Run("gaps", "rig", "wind", ("a", "b", "c"), n, MemorySource(channels, None), has_loads=False,
               sample_rate=RATE, rotor_speed=SPEED, pulse_times=pulses)  # fmt: skip


def with_gaps(run: Run, *spans: tuple[int, int], columns: object = 0) -> Run:
    channels = run.read().channels.copy()
    for start, stop in spans:
        channels[start:stop, columns] = np.nan
    return replace(run, source=MemorySource(channels, None))


def bridged(run: Run, *spans: tuple[int, int], columns: object = 0) -> Run:
    return bridge_gaps(with_gaps(run, *spans, columns=columns))


@pytest.mark.parametrize("spans", [[(4000, 4001)], [(4000, 4032)], [(0, 4)], [(9596, 9600)], [(7, 8), (4000, 4010)]])
def test_a_gap_is_filled_with_the_error_that_is_stated(spans):
    errors, stated = [], []
    for seed in range(6):
        run = rotor_run(seed)
        filled = bridged(run, *spans)
        (samples,) = filled.bridged
        assert samples.count == sum(stop - start for start, stop in spans)
        errors.append(filled.read().channels[samples.index, 0] - run.read().channels[samples.index, 0])
        stated.append(samples.errors)
    ratio = np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(stated)))
    assert 0.6 < ratio < 1.7
    assert np.sqrt(np.mean(np.square(errors))) < 0.2


WORST = {
    "one": [(3000, 3001)],
    "longest": [(3000, 3032)],
    "several": [(k, k + 13) for k in range(1000, 8000, 1000)],
    "at one azimuth": [(int(RATE / SPEED * k) + 5, int(RATE / SPEED * k) + 6) for k in range(2, 200, 3)],
    "ends": [(0, 32), (9568, 9600)],
    "all channels": [(3000, 3032), (6000, 6032)],
}


@pytest.mark.parametrize("case", WORST)
def test_harmonics_with_gaps_differ_from_those_without_by_the_error_that_is_stated(case):
    columns = slice(None) if case == "all channels" else 0
    difference, stated, z = [], [], []
    for seed in range(3):
        run = rotor_run(seed, noise=0.002, resonance=0.5, hiss=0.5)
        filled, azimuth = bridged(run, *WORST[case], columns=columns), azimuth_from_pulses(run.pulse_times)
        whole, found, without = (
            estimate_harmonics(item, azimuth, 6) for item in (run, filled, replace(filled, bridged=()))
        )
        difference.append(np.abs((found.amplitude - whole.amplitude)[1:, 0]) ** 2)
        stated.append((found.covariance - without.covariance)[1:, 0, 0].real)
        error = (found.amplitude[:, 0] - [0.0, *np.exp(1j * np.arange(1, 5)), 0.0, 0.0])[1:]
        z.append(np.abs(error) ** 2 / found.covariance[1:, 0, 0].real)
    assert 0.4 < np.sqrt(np.mean(difference) / np.mean(stated)) < 2.0
    assert 0.7 < np.sqrt(np.mean(z)) < 1.3


def test_the_error_of_gaps_in_noise_that_nothing_predicts_is_that_of_the_missing_samples():
    run = rotor_run(3)
    noise = np.random.default_rng(1).standard_normal((9600, 3))
    filled = bridged(replace(run, source=MemorySource(noise, None)), (4000, 4030), (4045, 4075), (7000, 7030))
    azimuth = azimuth_from_pulses(run.pulse_times)
    ignored, stated = (
        estimate_harmonics(item, azimuth, 4).covariance for item in (replace(filled, bridged=()), filled)
    )
    added = np.mean((stated - ignored)[1:, 0, 0].real)
    assert added / (90 * (2 / 9600) ** 2) == pytest.approx(1.0, abs=0.5)
    np.testing.assert_array_equal(stated[:, 1, 1], ignored[:, 1, 1])


@pytest.mark.parametrize(
    "spans",
    [[(100, 101 + LONGEST_GAP)], [(k, k + 1) for k in range(10, 9600, 90)], [(0, 9600)]],
    ids=["long", "many", "all"],
)
def test_a_channel_with_too_many_missing_samples_stays_as_it_is_and_is_left_out(spans):
    run = with_gaps(rotor_run(0), *spans)
    assert bridge_gaps(run) is run
    assert "more than can be bridged" in channel_faults(run, {"a": None})["a"]


def test_blocks_and_excerpts_hold_the_same_values():
    filled = bridged(rotor_run(0), (500, 510), (1000, 1001), (8190, 8195))
    whole = filled.read().channels
    np.testing.assert_array_equal(np.concatenate([block.channels for block in filled.blocks(97)]), whole)
    assert np.isfinite(whole).all()
    part = excerpt_run(filled, 505, 2000)
    np.testing.assert_array_equal(part.read().channels, whole[505:2000])
    assert part.bridged[0].gaps == ((0, 5), (495, 496))


def test_a_short_record_and_a_constant_channel_are_bridged_on_the_safe_side():
    run = rotor_run(0)
    short = replace(run, samples=120, source=MemorySource(run.read(0, 120).channels, None))
    (samples,) = bridged(short, (60, 61)).bridged
    assert np.sqrt(np.mean(samples.errors**2)) > 0.5 * short.read().channels[:, 0].std()
    constant = replace(run, source=MemorySource(np.full((9600, 3), 2.5), None))
    filled = bridged(constant, (150, 152))
    assert np.all(filled.read().channels == 2.5) and not filled.bridged[0].errors.any()


def test_a_file_is_bridged_when_it_is_read_and_keeps_its_digest(tmp_path):
    run = with_gaps(rotor_run(0), (500, 503), (900, 901))
    write_run(tmp_path / "run.h5", run)
    filled = open_run(tmp_path / "run.h5")
    assert gap_summary(filled) == {"a": {"samples": 4, "gaps": 2, "longest": 3}}
    assert describe_gaps(filled) == "missing samples interpolated: a (4 in 2 gaps, longest 3)"
    assert filled.digest == run_digest(replace(filled, source=filled.source.measured))
    with h5py.File(tmp_path / "run.h5") as file:
        assert np.isnan(file["channels"][500, 0])


def test_gaps_of_the_loads_are_left_for_the_check_of_the_run():
    run = rotor_run(0)
    loads = np.zeros((9600, 6))
    loads[700:704, 2] = np.nan
    broken = replace(run, has_loads=True, source=MemorySource(run.read().channels, loads))
    assert bridge_gaps(broken) is broken
    assert [fault.place for fault in load_sample_faults(broken)] == ["loads, column Fz"]


# ---- load points -----------------------------------------------------------------------------------------------------


def static_run(rows: int = 40) -> Run:
    rng = np.random.default_rng(1)
    loads = np.zeros((rows, 6))
    loads[:, 2] = 10.0 * np.arange(rows)
    channels = np.column_stack([loads[:, 2], -loads[:, 2], loads[:, 2]]) + rng.standard_normal((rows, 3))
    labels = tuple(str(row // 10) for row in range(rows))
    return Run("static", "rig", "static", ("a", "b", "c"), rows, MemorySource(channels, loads), trim="bare",
               series_labels=labels, attitude=np.outer(np.arange(rows), [1.0, 0.1]))  # fmt: skip


def unread(run: Run, *places: tuple[int, int]) -> Run:
    block = run.read()
    channels = block.channels.copy()
    for row, column in places:
        channels[row, column] = np.nan
    return bridge_gaps(replace(run, source=MemorySource(channels, block.loads)))


def test_a_load_point_that_a_channel_did_not_read_is_left_out_and_the_channel_is_not():
    whole = static_run()
    run = unread(whole, (17, 0), (17, 1))
    kept = np.delete(np.arange(40), 17)
    block, original = run.read(), whole.read()
    assert run.samples == 39 and np.array_equal(block.channels, original.channels[kept])
    assert np.array_equal(block.loads, original.loads[kept]) and np.array_equal(run.attitude, whole.attitude[kept])
    assert run.series_labels == tuple(whole.series_labels[row] for row in kept)
    assert channel_faults(run, dict.fromkeys("abc")) == {}
    assert describe_gaps(run).startswith("load point 18 of the file is left out, where a, b is not finite")
    assert gap_summary(run)["a"] == {"samples": 1, "gaps": 1, "longest": 1}


def test_a_channel_that_misses_many_load_points_costs_no_rows():
    run = unread(static_run(), (3, 0), *((row, 1) for row in range(10, 20)))
    assert run.samples == 39 and [item.name for item in run.bridged] == ["a"]
    assert list(channel_faults(run, dict.fromkeys("abc"))) == ["b"]
    assert unread(static_run(8), (3, 0)).samples == 8


@pytest.mark.parametrize("twice", [lambda x: np.repeat(x, 2, axis=0), lambda x: np.concatenate([x, x])])
def test_load_points_that_were_entered_twice_count_once_and_are_named(twice):
    whole = replace(static_run(), series_labels=None, attitude=None)
    block = whole.read()
    doubled = replace(whole, samples=80, source=MemorySource(twice(block.channels), twice(block.loads)))
    run = bridge_gaps(doubled)
    assert np.array_equal(run.read().channels, block.channels) and np.array_equal(run.read().loads, block.loads)
    assert "left out as copies of others in every digit" in describe_gaps(run) and "and 30 more" in describe_gaps(run)
    assert gap_summary(run) == {} and len(run.copied_rows) == 40
    # A tared instrument reads the same zero between load series; that is no copy.
    zeros = np.where(np.isin(np.arange(40), (19, 20))[:, None], 0.0, block.channels), np.zeros((40, 6))
    assert bridge_gaps(replace(whole, source=MemorySource(*zeros))).samples == 40


def test_a_load_series_under_two_labels_counts_once():
    whole = replace(static_run(), attitude=None)
    block = whole.read()
    again = np.r_[np.arange(40), np.arange(10, 20)]
    labels = tuple(np.repeat(["1", "2", "3", "4", "5"], 10).tolist())
    source = MemorySource(block.channels[again], block.loads[again])
    run = bridge_gaps(replace(whole, samples=50, series_labels=labels, point_kinds=None, source=source))
    assert run.samples == 40 and run.copied_rows == tuple(range(40, 50))
    assert bridge_gaps(replace(whole, series_labels=labels[:40], point_kinds=None)).samples == 40


def test_a_load_point_without_its_load_is_left_out_and_one_load_that_is_often_missing_is_a_fault():
    whole = static_run()
    block = whole.read()
    loads = block.loads.copy()
    loads[5, 2] = np.nan
    run = bridge_gaps(replace(whole, source=MemorySource(block.channels, loads)))
    assert run.samples == 39 and np.isfinite(run.read().loads).all()
    assert describe_gaps(run).startswith("load point 6 of the file is left out, where Fz is not finite")
    loads[5:15, 2] = np.nan
    run = bridge_gaps(replace(whole, source=MemorySource(block.channels, loads)))
    assert run.samples == 40 and [str(fault.fault)[:8] for fault in load_sample_faults(run)] == ["10 of 40"]


@pytest.mark.parametrize("repeats", [2, 3])
@pytest.mark.parametrize("range_in_counts", [30, 500])
def test_readings_that_a_coarse_converter_repeats_were_not_entered_twice(repeats, range_in_counts):
    """Of 108 load points, each read twice by a converter that shows no noise, 50 had been left out as copies."""
    rng = np.random.default_rng(7)
    steps = np.r_[np.arange(5), np.arange(3, -1, -1)] / 4
    x = np.vstack([np.outer(side * steps, axis) for axis in np.eye(3) for side in (1, -1)]).repeat(repeats, axis=0)
    matrix = np.array([[1.0, 0.2, -0.3], [0.1, -0.8, 0.2], [0.3, 0.1, 1.2]])
    counts = np.round(range_in_counts * x @ matrix + 0.05 * rng.standard_normal(x.shape)) + 37
    loads = np.hstack([100.0 * x, np.zeros((len(x), 3))])
    plain = replace(static_run(len(x)), series_labels=None, attitude=None)
    assert bridge_gaps(replace(plain, source=MemorySource(counts, loads))).samples == len(x)
    fine = 20000.0 * x @ matrix + np.round(20.0 * rng.standard_normal(x.shape))
    copied = np.insert(np.arange(len(x)), 12, 12)
    run = bridge_gaps(replace(plain, samples=len(x) + 1, source=MemorySource(fine[copied], loads[copied])))
    assert len(run.copied_rows) == 1


def test_spikes_of_one_sample_are_interpolated():
    """Thirty spikes of one sign had moved the mean by five standard deviations, with an empty flag."""
    run, rng = rotor_run(5), np.random.default_rng(8)
    volts = np.array(run.read().channels)
    index = np.sort(rng.choice(np.arange(20, run.samples - 20, 8), 30, replace=False))
    volts[index, 1] += 0.6 * volts[:, 1].std()
    found = bridge_gaps(replace(run, source=MemorySource(volts, None)))
    assert gap_summary(found) == {"b": {"samples": 30, "gaps": 30, "longest": 1, "spikes": 30}}
    np.testing.assert_array_equal(found.bridged[0].index, index)
    assert "30 of them are spikes" in describe_gaps(found)
    error = found.read().channels[:, 1] - run.read().channels[:, 1]
    assert abs(error.mean()) < 0.05 * 30 * 0.6 * volts[:, 1].std() / run.samples


def test_offsets_of_a_few_samples_are_interpolated():
    run, rng = rotor_run(5), np.random.default_rng(10)
    volts = np.array(run.read().channels)
    starts, lengths = np.arange(200, 200 + 20 * 400, 400), rng.integers(1, 9, 20)
    index = np.concatenate([np.arange(a, a + n) for a, n in zip(starts, lengths, strict=True)])
    volts[index, 2] -= 1.5 * volts[:, 2].std()
    found = bridge_gaps(replace(run, source=MemorySource(volts, None)))
    assert set(found.bridged[0].index) == set(index) and found.bridged[0].name == "c"
    steps = np.array(run.read().channels)
    steps[3000:, 2] += 1.5 * volts[:, 2].std()
    assert not bridge_gaps(replace(run, source=MemorySource(steps, None))).bridged


@pytest.mark.parametrize("width", [1.0, 1.5, 3.0])
def test_pulses_of_loads_behind_the_filter_are_no_spikes(width):
    """Short blows once in a revolution behind an anti-alias filter at 0.45 of the sample rate, and noise."""
    run, rng = rotor_run(6), np.random.default_rng(9)
    blows = np.zeros((4 * run.samples, 3))
    blows[np.arange(60, len(blows), round(4 * RATE / SPEED))] = 40.0
    shape = np.exp(-((np.arange(-40, 41) / (4 * width)) ** 2))
    sos = signal.butter(6, 0.9 * RATE / 2, fs=4 * RATE, output="sos")
    filtered = signal.sosfilt(sos, signal.fftconvolve(blows, shape[:, None], "same", axes=0), axis=0)[::4]
    for volts in (filtered, filtered + run.read().channels, 1e-3 * rng.standard_normal(filtered.shape)):
        assert not bridge_gaps(replace(run, source=MemorySource(volts, None))).bridged
