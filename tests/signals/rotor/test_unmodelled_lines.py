import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.signals.rotor.azimuth import azimuth_from_pulses
from balance_cli.signals.rotor.unmodelled_lines import unmodelled_lines

RATE, SPEED, DURATION = 1000.0, 13.0, 30.0
TIME = np.arange(int(RATE * DURATION)) / RATE
TURNS = SPEED * TIME + 0.6 * np.sin(2 * np.pi * TIME / 17.0)


def lines(*, orders=None, tones=None, n=8, noise=1e-3):
    """Lines found beside n harmonics in a record of these orders {n/rev: amplitude} and tones {Hz: amplitude}."""
    rng = np.random.default_rng(1)
    wave = sum(1.0 / k * np.cos(2 * np.pi * k * TURNS + k) for k in range(1, 9))
    wave = wave + sum(a * np.cos(2 * np.pi * k * TURNS) for k, a in (orders or {}).items())
    wave = wave + sum(a * np.cos(2 * np.pi * f * TIME) for f, a in (tones or {}).items())
    channels = np.column_stack([0.3 * wave, wave]) + noise * rng.standard_normal((len(TIME), 2))
    pulses = np.interp(np.arange(int(TURNS[-1]) + 1), TURNS, TIME)
    run = Run(
        "w", "rig", "wind", ("a", "b"), len(TIME), MemorySource(channels, None), sample_rate=RATE, pulse_times=pulses
    )  # fmt: skip
    azimuth = azimuth_from_pulses(run.pulse_times)
    return unmodelled_lines(run, azimuth, ("a", "b"), n, (azimuth.first, azimuth.last))


@pytest.mark.parametrize("noise", [1e-4, 1e-2, 1.0])
def test_harmonics_that_are_reduced_and_noise_are_no_lines(noise):
    assert lines(noise=noise) == ()


@pytest.mark.parametrize("order", [9, 12, 24])
def test_a_higher_harmonic_is_named_however_the_speed_varies(order):
    (line,) = lines(orders={order: 0.4})
    assert line.turns_with_rotor
    assert line.order == order
    assert f"{order}/rev" in line.description
    assert line.amplitude == pytest.approx(0.4, rel=0.25) or line.channel == "a"


def test_a_harmonic_that_is_reduced_is_no_line():
    assert lines(orders={12: 0.4}, n=12) == ()


@pytest.mark.parametrize("frequency", [50.0, 6.4, 127.3])
def test_a_tone_that_does_not_turn_with_the_rotor_is_named(frequency):
    (line,) = lines(tones={frequency: 0.3})
    assert not line.turns_with_rotor
    assert line.frequency == pytest.approx(frequency, abs=0.05)


def test_a_line_too_small_to_matter_is_not_reported():
    assert lines(orders={9: 0.01}, tones={50.0: 0.01}) == ()
