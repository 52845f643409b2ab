import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.signals.record_spectrum import record_spectrum
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
    return unmodelled_lines(record_spectrum(run, ("a", "b"), (azimuth.first, azimuth.last)), azimuth, n)


@pytest.mark.parametrize("noise", [1e-4, 1e-2, 1.0])
def test_harmonics_that_are_reduced_and_noise_are_no_lines(noise):
    assert lines(noise=noise) == ()


@pytest.mark.parametrize("order", [9, 12, 24])
def test_a_higher_harmonic_is_named_however_the_speed_varies(order):
    (line,) = lines(orders={order: 0.4})
    assert line.turns_with_rotor
    assert line.order == order
    assert f"{order}/rev" in line.description
    assert "1 to 8 are free of it" in line.explain(8, 24)
    assert "may leak" in line.explain(8, order - 1)
    assert line.amplitude == pytest.approx(0.4, rel=0.25) or line.channel == "a"


def test_a_harmonic_that_is_reduced_is_no_line():
    assert lines(orders={12: 0.4}, n=12) == ()


@pytest.mark.parametrize("frequency", [50.0, 6.4, 127.3])
def test_a_tone_that_does_not_turn_with_the_rotor_is_named(frequency):
    (line,) = lines(tones={frequency: 0.3})
    assert not line.turns_with_rotor
    assert line.frequency == pytest.approx(frequency, abs=0.05)
    assert "may leak into the harmonics beside it" in line.explain(8, 24)


def test_a_line_too_small_to_matter_is_not_reported():
    assert lines(orders={9: 0.01}, tones={50.0: 0.01}) == ()


def test_a_light_mode_that_gusts_excite_is_no_line_where_the_response_explains_it():
    rng = np.random.default_rng(3)
    rate, seconds, mode, zeta = 250.0, 48.0, 3.47, 0.0005
    n = int(rate * seconds)
    time = np.arange(n) / rate
    w = 2 * np.pi * np.fft.rfftfreq(3 * n, 1 / rate)
    w0 = 2 * np.pi * mode
    response = w0**2 / (w0**2 - w**2 + 2j * zeta * w * w0)
    swaying = np.fft.irfft(np.fft.rfft(rng.standard_normal(3 * n)) * response, 3 * n)[n : 2 * n]
    psi = 2 * np.pi * 4.2 * time
    values = np.stack([np.cos(psi) + 0.05 * swaying + 1e-4 * rng.standard_normal(n)] * 2, axis=1)
    azimuth = azimuth_from_pulses(np.arange(0, seconds, 1 / 4.2))
    run = Run("r", "r", "wind", ("a", "b"), n, MemorySource(values, None), has_loads=False, sample_rate=rate)

    def power_gain(frequency):
        H = w0**2 / (w0**2 - (2 * np.pi * frequency) ** 2 + 2j * zeta * 2 * np.pi * frequency * w0)
        return np.tile(np.abs(H)[:, None, None] ** 2, (1, 2, 6))

    arguments = (record_spectrum(run, ("a", "b"), (azimuth.first, azimuth.last)), azimuth, 8)
    assert [round(line.frequency, 1) for line in unmodelled_lines(*arguments)] == [3.5]
    assert unmodelled_lines(*arguments, power_gain) == ()
