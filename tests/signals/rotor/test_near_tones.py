"""Tones within the lobe of a harmonic, beside loads that drift or step, which are no tones."""

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.signals.rotor.azimuth import azimuth_from_pulses
from balance_cli.signals.rotor.harmonics import estimate_harmonics
from balance_cli.signals.rotor.near_tones import find_near_tones

RATE, SPEED, TURNS = 500.0, 10.0, 60
NOISE = 0.05


def _tones(signal, seed):
    """Tones beside harmonics 1 to 3 of a signal of time [revolutions], in two channels."""
    time = np.arange(int((TURNS + 0.3) * RATE / SPEED)) / RATE
    values = np.stack([signal(time * SPEED), 0.5 * signal(time * SPEED)], axis=1)
    values += NOISE * np.random.default_rng(seed).standard_normal(values.shape)
    pulses = np.arange(TURNS + 1) / SPEED
    run = Run(
        name="w",
        rig="r",
        kind="wind",
        channel_names=("a", "b"),
        samples=len(time),
        source=MemorySource(values, None),
        has_loads=False,
        sample_rate=RATE,
        rotor_speed=SPEED,
        pulse_times=pulses,
    )
    # A start within the record: the phases of lines count from there.
    spectra = estimate_harmonics(run, azimuth_from_pulses(pulses), 3, first_revolution=7)
    assert spectra.noise_lines is not None
    return find_near_tones(spectra.noise_lines, [0, 1])


def _rotor(turns):
    return np.cos(2 * np.pi * turns) + 0.5 * np.cos(4 * np.pi * turns + 1.0)


@pytest.mark.parametrize("distance", [-3.3, -1.8, 0.7, 1.2, 2.6])
def test_a_tone_beside_a_harmonic_is_found(distance):
    order = 2.0 + distance / (TURNS - 7)
    tones = _tones(lambda turns: _rotor(turns) + 0.15 * np.cos(2 * np.pi * order * turns + 0.4), 1)
    assert tones.distance[1] == pytest.approx(distance, abs=0.1)
    np.testing.assert_allclose(tones.amplitude[1], [0.15, 0.075], rtol=0.2)
    assert tones.power[1].max() > tones.least_power[1]
    assert np.all(tones.power[[0, 2]] < tones.least_power[[0, 2], None])


@pytest.mark.parametrize(("distance", "size"), [(-0.35, 0.6), (0.3, 0.8), (0.45, 0.3)])
def test_a_tone_nearer_than_half_a_bin_turns_the_harmonic(distance, size):
    """Its departure follows an arc; such tones had left up to 640 standard deviations without a flag."""
    order = 2.0 + distance / (TURNS - 7)
    tones = _tones(lambda turns: _rotor(turns) + size * np.cos(2 * np.pi * order * turns + 0.4), 1)
    assert tones.distance[1] == pytest.approx(distance, abs=0.1)
    assert tones.power[1].max() > tones.least_power[1]
    assert np.all(tones.power[[0, 2]] < tones.least_power[[0, 2], None])


CHANGES = {
    "curved": lambda x: 0.3 * x**2,
    "half a sine": lambda x: 0.3 * np.sin(np.pi * x),
    "none": lambda x: np.zeros_like(x),
    "ramp": lambda x: 0.3 * x,
    "step": lambda x: 0.3 * (x > 0.5),
    "sine": lambda x: 0.2 * np.sin(2 * np.pi * x + 0.5),
    "burst": lambda x: 0.6 * ((x > 0.4) & (x < 0.57)),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_load_that_changes_is_no_tone(change):
    for seed in range(5):
        tones = _tones(lambda turns: _rotor(turns) * (1.0 + CHANGES[change](turns / TURNS)), seed)
        assert np.all(tones.power < tones.least_power[:, None])
