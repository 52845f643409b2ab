"""What the channels tell of a periodic departure of the pulses where all of them have a strong random load."""

from types import SimpleNamespace

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.signals.rotor.azimuth import azimuth_from_pulses
from balance_cli.signals.rotor.pulse_error import OrderedRecord, judge_pattern
from balance_cli.signals.rotor.pulse_pattern import pulse_pattern, without_pattern

SPEED, RATE, TURNS, PERIOD, DEGREES = 10.0, 200.0, 150, 30.0, 0.6
NAMES = tuple(f"c{i}" for i in range(12))
HARMONICS = np.arange(1, 9)


def verdict(seed, pulses_are_wrong, noise):
    """Return the verdict on records of 12 channels of one force: loads that turn with the rotor, and a random one."""
    rng = np.random.default_rng(seed)
    time = np.arange(int(TURNS / SPEED * RATE)) / RATE
    departure = np.radians(DEGREES) * np.sin(2 * np.pi * SPEED / PERIOD * time)
    psi = 2 * np.pi * SPEED * time + (0.0 if pulses_are_wrong else departure)
    seen = (2 * np.pi * SPEED * time + departure) / (2 * np.pi)
    phases = np.exp(2j * np.pi * rng.random(8))
    force = (np.exp(1j * np.outer(psi, HARMONICS)) @ phases).real + noise * rng.standard_normal(len(time))
    volts = np.outer(force, rng.uniform(0.5, 2.0, len(NAMES)))
    volts += 1e-3 * rng.standard_normal(volts.shape)
    pulses = np.interp(np.arange(TURNS), seen, time)
    run = Run("wind", "rig", "wind", NAMES, len(time), MemorySource(volts, None), has_loads=False, sample_rate=RATE)
    given = azimuth_from_pulses(pulses)
    pattern = pulse_pattern(given.pulse_times, given.revolutions)
    assert pattern.degrees == pytest.approx(DEGREES, rel=0.05)
    smooth = azimuth_from_pulses(without_pattern(given.pulse_times, given.revolutions, pattern))
    spectra = SimpleNamespace(frequency_hz=np.arange(9) * SPEED, revolutions=(0, TURNS - 1))
    records = [OrderedRecord(run, azimuth, spectra) for azimuth in (given, smooth)]
    return judge_pattern(*records, pattern, NAMES)


@pytest.mark.parametrize("pulses_are_wrong", [False, True])
def test_a_random_load_in_all_channels_is_no_doubt(pulses_are_wrong):
    """Twelve channels of one line had counted as twelve lines: a record had 48 loads `not steady`, its pulses moved."""
    verdicts = [verdict(seed, pulses_are_wrong, 0.2) for seed in range(16)]
    decided = [item for item in verdicts if item is not None]
    assert len(decided) >= 4
    assert all(item.share == pulses_are_wrong and not item.contradicted for item in decided)


@pytest.mark.parametrize("pulses_are_wrong", [False, True])
def test_clear_lines_tell(pulses_are_wrong):
    for seed in range(3):
        found = verdict(seed, pulses_are_wrong, 0.02)
        assert found.share == pulses_are_wrong
        assert not found.contradicted
