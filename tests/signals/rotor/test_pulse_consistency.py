from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import maximum_filter1d

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.signals.rotor.pulse_consistency import pulse_faults, speed_fault
from balance_cli.signals.rotor.record_length import revolution_faults
from balance_cli.signals.rotor.spectral_floor import local_maxima

SPEED, RATE, DURATION = 11.0, 500.0, 40.0


def record(
    pulses_at=SPEED, stated_speed=SPEED, stated_rate=RATE, last=DURATION, orders=(1, 2, 3, 4, 6), noise=1e-3, wobble=0.0
):
    """A record of a rotor at `SPEED`, sampled at `RATE`, that may state something else of itself."""
    time = np.arange(int(DURATION * RATE)) / RATE
    turns = SPEED * time + wobble * np.sin(2 * np.pi * time / 15.0)
    rng = np.random.default_rng(1)
    waves = sum(np.cos(2 * np.pi * k * turns[:, None] + np.arange(3)) / k for k in orders) if orders else 0.0
    channels = waves + noise * rng.standard_normal((len(time), 3))
    count = np.arange(0, int(last * pulses_at)) * SPEED / pulses_at
    pulses = np.interp(count, turns, time)
    names = ("a", "b", "c")
    return Run(
        "w", "rig", "wind", names, len(time), MemorySource(channels, None), sample_rate=stated_rate,
        rotor_speed=stated_speed, pulse_times=pulses,
    )  # fmt: skip


@pytest.mark.parametrize(
    "sound",
    [
        {},
        {"stated_speed": 1.05 * SPEED},
        {"wobble": 0.5},
        {"orders": ()},
        {"orders": (3,)},
        {"orders": (2, 4)},
        {"noise": 1.0},
        {"last": 0.9 * DURATION},
        {"stated_speed": 0.0},
    ],
)
def test_a_sound_record_has_no_fault(sound):
    assert list(pulse_faults(record(**sound))) == []


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"pulses_at": SPEED / 2}, "once in 2 revolutions"),
        ({"pulses_at": SPEED / 4}, "once in 4 revolutions"),
        ({"pulses_at": 2 * SPEED}, "2 times in each revolution"),
        ({"pulses_at": 60 * SPEED}, "60 times in each revolution"),
        ({"stated_speed": 60 * SPEED}, "1/min was given as Hz"),
        ({"stated_speed": 1.5 * SPEED}, "`rotor_speed` is 16.5 Hz"),
        ({"last": DURATION / 2}, "the pulses cover 0 to"),
        ({"stated_rate": 2 * RATE}, "of a record of 20 s"),
        ({"stated_rate": 1.01 * RATE}, "the channels have their lines at multiples of 11.1"),
        ({"stated_rate": 0.9 * RATE, "wobble": 0.1}, "the channels have their lines at multiples of "),
        ({"stated_rate": 1.1 * RATE}, "the channels have their lines at multiples of 12."),
    ],
)
def test_what_contradicts_the_pulses_is_named(wrong, words):
    (fault,) = pulse_faults(record(**wrong))
    assert words in str(fault)
    assert "rotor/pulse_times" in str(fault)


@pytest.mark.parametrize("bounce", [0.004, 0.03])
def test_pulses_of_a_contact_that_bounces_are_named(bounce):
    run = record()
    twice = np.sort(np.concatenate([run.pulse_times, run.pulse_times + bounce]))[:-1]
    (fault,) = pulse_faults(replace(run, pulse_times=twice))
    assert f"in pairs {1e3 * bounce:.3g} ms apart" in str(fault)


def test_ratios_of_speeds():
    assert speed_fault(17.0, 17.5) == ""
    assert "3 times" in speed_fault(52.4, 17.5)
    assert "in 8 revolutions" in speed_fault(2.19, 17.5)


def test_local_maxima_are_those_of_a_maximum_filter():
    values = np.random.default_rng(0).integers(0, 9, 500).astype(np.float32)
    for length in (1, 5, 500):
        expected = values[:length] == maximum_filter1d(values[:length], 7)
        np.testing.assert_array_equal(local_maxima(values[:length]), expected)


@pytest.mark.parametrize(("skipped", "orders"), [(2, (1, 2, 3, 4, 6)), (3, (1, 2, 3, 5, 6)), (2, (1, 3, 4, 6, 8))])
def test_pulses_that_skip_revolutions_are_found_though_the_stated_speed_is_theirs(skipped, orders):
    run = record(pulses_at=SPEED / skipped, stated_speed=SPEED / skipped, orders=orders)
    (fault,) = pulse_faults(run, 1.03 * SPEED)
    assert f"once in {skipped} revolutions of the rotor" in str(fault)
    assert list(pulse_faults(run)) == []


def test_a_rotor_may_turn_at_half_of_its_declared_speed():
    for orders in ((1, 2, 3, 4, 6), (2, 4, 6, 8, 9)):
        assert list(pulse_faults(record(orders=orders), 2 * SPEED)) == []
    assert list(pulse_faults(record(orders=(2, 4, 6, 8, 10)), 1.5 * SPEED)) == []


@pytest.mark.parametrize(("pulses", "orders"), [(2, (1, 2, 3, 4, 5)), (4, (1, 2, 3, 4, 6)), (60, (1, 2, 3, 4, 6))])
def test_several_pulses_a_revolution_are_found_though_the_stated_speed_is_theirs(pulses, orders):
    """As `import` states it where the map forgets `pulses_per_revolution`."""
    run = record(pulses_at=pulses * SPEED, stated_speed=pulses * SPEED, orders=orders)
    (fault,) = pulse_faults(run, 1.03 * SPEED)
    assert f"{pulses} times in each revolution of the rotor, whose declared speed is 11.33 Hz" in str(fault)


def test_a_rotor_may_turn_at_twice_its_declared_speed():
    for orders in ((1, 2, 3, 4, 6), (1, 2, 3, 4.5, 5, 6), ()):
        assert list(pulse_faults(record(orders=orders), 0.5 * SPEED)) == []


@pytest.mark.parametrize("first", [0.05, 0.95])
def test_a_record_of_few_revolutions_is_short_and_has_no_wrong_rate(first):
    """The partial revolution at its start was a quarter of the record: `sample_rate` was to be checked."""
    run = record()
    samples, start = int(3.6 / SPEED * RATE), first / SPEED
    channels = MemorySource(np.asarray(run.read(0, samples).channels), None)
    pulses = np.arange(start, samples / RATE, 1.0 / SPEED)
    short = replace(run, samples=samples, source=channels, pulse_times=pulses)
    assert list(pulse_faults(short)) == []
    (fault,) = revolution_faults(short)
    assert "revolutions; at least 10 are needed" in fault.fault
