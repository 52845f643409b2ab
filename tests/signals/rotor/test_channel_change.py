"""Changes of one channel alone, and turns of all harmonics, in amplitudes of windows of a record."""

import numpy as np
import pytest

from balance_cli.signals.rotor.channel_change import channel_change
from balance_cli.signals.rotor.common_turn import common_turn

WINDOWS, HARMONICS, CHANNELS, NOISE = 26, 8, 6, 0.03
SENSORS = np.arange(CHANNELS)


def amplitudes(seed=0, noise=NOISE, windows=WINDOWS):
    """Amplitudes (w, n, c) of size 1 and less, with noise; the standard deviation (n, c) of their means."""
    rng = np.random.default_rng(seed)

    def normal(*shape):
        return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)

    size = normal(HARMONICS, CHANNELS) / np.arange(1, HARMONICS + 1)[:, None] ** 0.7
    values = size + noise * normal(windows, HARMONICS, CHANNELS)
    return values, np.full((HARMONICS, CHANNELS), noise / np.sqrt(windows))


def changed(values, factor, channel=3, since=13):
    """The harmonics of a channel, multiplied by factors (n,) or (w, n) from a window on."""
    values = values.copy()
    values[since:, :, channel] *= np.broadcast_to(factor, (len(values), HARMONICS))[since:]
    return values


def turned(angle):
    return np.exp(1j * angle * np.arange(1, HARMONICS + 1))


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        (np.full(8, 1.2), " times their size"),
        (np.full(8, 0.8), " times their size"),
        (turned(0.05), "turn by harmonic"),
    ],
)
def test_a_channel_that_changes_alone_is_found(factor, said):
    for seed in range(10):
        values, sigma = amplitudes(seed, noise=0.01)
        change = channel_change(changed(values, factor), SENSORS, sigma)
        assert change is not None and change.column == 3 and abs(change.window - 13) <= 1
        assert said in change.description


def test_a_gain_that_drifts_is_found():
    drift = 1.0 + 0.15 * np.linspace(-0.5, 0.5, WINDOWS)[:, None] * np.ones(HARMONICS)
    values, sigma = amplitudes(1, noise=0.01)
    change = channel_change(changed(values, drift, since=0), SENSORS, sigma)
    assert change is not None and change.column == 3 and "gain or excitation" in change.question


def test_steady_amplitudes_and_those_of_loads_that_change_are_left():
    for seed in range(200):
        values, sigma = amplitudes(seed, noise=(0.003, 0.03, 0.2)[seed % 3], windows=(8, 13, 26, 48)[seed % 4])
        assert channel_change(values, SENSORS, sigma) is None
    values, sigma = amplitudes(0)
    one_harmonic = np.ones(HARMONICS)
    one_harmonic[0] = 1.5
    assert channel_change(changed(values, one_harmonic), SENSORS, sigma) is None
    thrust = changed(changed(values, np.full(8, 1.1), 3), np.full(8, 1.1), 4)
    assert channel_change(thrust, SENSORS, sigma) is None


def test_two_channels_of_one_sensor_may_change_together():
    values, sigma = amplitudes(0, noise=0.01)
    both = changed(changed(values, np.full(8, 1.1), 3), np.full(8, 1.1), 4)
    assert channel_change(both, np.array([0, 1, 2, 3, 3, 4]), sigma) is not None


def test_windows_that_one_channel_lacks_are_found_where_they_matter():
    values, sigma = amplitudes(2)
    values[[5, 6, 14], :, 1] *= 0.1
    change = channel_change(values, SENSORS, sigma)
    assert change is not None and change.column == 1 and "3 of 26 windows" in change.description
    assert channel_change(values, SENSORS, 100.0 * sigma) is None
    values[[5, 6, 14]] *= 0.1  # all channels: a load
    assert channel_change(values, SENSORS, sigma) is None


@pytest.mark.parametrize("since", [13, 23])
@pytest.mark.parametrize("angle", [0.05, 0.6, -0.6])
def test_a_slip_of_the_azimuth_is_found(angle, since):
    values, sigma = amplitudes(3)
    values[since:] *= turned(angle)[:, None]
    turn = common_turn(values, np.ones((HARMONICS, CHANNELS)), sigma)
    assert turn is not None and not turn.is_steady and abs(turn.window - since) <= 1
    assert turn.turn == pytest.approx(angle, abs=0.01)
    change = channel_change(values, SENSORS, sigma)
    assert change is not None and change.column is None and "azimuth slip" in change.question


@pytest.mark.parametrize("step", [0.01, 0.1, -0.3])
def test_pulses_of_another_record_are_found(step):
    values, sigma = amplitudes(4)
    values = values * np.exp(1j * step * np.arange(WINDOWS)[:, None] * np.arange(1, HARMONICS + 1))[:, :, None]
    turn = common_turn(values, np.ones((HARMONICS, CHANNELS)), sigma)
    assert turn is not None and turn.is_steady and turn.turn == pytest.approx(step, rel=0.1)
    change = channel_change(values, SENSORS, sigma)
    assert change is not None and "sample_rate" in change.question


@pytest.mark.parametrize("windows", [10, 26, 48])
def test_clocks_of_pulses_and_samples_that_differ_are_found(windows):
    """A difference of 2e-4 had left more than 2000 standard deviations without a flag."""
    for seed in range(10):
        values, sigma = amplitudes(seed, noise=2e-3, windows=windows)
        steps = 0.02 / windows * np.arange(windows)[:, None] * np.arange(1, HARMONICS + 1)
        change = channel_change(values * np.exp(1j * steps)[:, :, None], SENSORS, sigma)
        assert change is not None and change.column is None and "clock" in change.question
        # A turn that sigma covers, and a load whose phase drifts.
        assert channel_change(values * np.exp(1j * steps)[:, :, None], SENSORS, 100.0 * sigma) is None
        values[:, 0] *= np.exp(1j * steps[:, :1])
        assert channel_change(values, SENSORS, sigma) is None


@pytest.mark.parametrize("orders", [(4,), (2,), (4, 8), (2, 4, 6, 8)])
def test_harmonics_of_the_blades_alone_are_steady_and_their_turns_are_found(orders):
    """Harmonics of a hub that passes multiples of the blades only agree at every part of a revolution between two."""
    is_left_out = ~np.isin(np.arange(1, HARMONICS + 1), orders)
    for seed in range(20):
        values, sigma = amplitudes(seed, noise=1e-4)
        values[:, is_left_out] = amplitudes(seed + 99, noise=1e-4)[0][:, is_left_out]
        values[:, is_left_out] -= amplitudes(seed + 99, noise=0.0)[0][:, is_left_out]
        assert common_turn(values, np.ones((HARMONICS, CHANNELS)), sigma) is None
        assert channel_change(values, SENSORS, sigma) is None
        steps = 0.01 * np.arange(WINDOWS)[:, None] * np.arange(1, HARMONICS + 1)
        turn = common_turn(values * np.exp(1j * steps)[:, :, None], np.ones((HARMONICS, CHANNELS)), sigma)
        assert turn is not None and turn.is_steady and turn.turn == pytest.approx(0.01, rel=0.1)


def test_amplitudes_without_noise_have_a_coherence_of_one():
    """Rounding put it above one, and the square root of what is missing had no value."""
    values = np.repeat(amplitudes(noise=0.0)[0][:1], WINDOWS, axis=0)
    with np.errstate(invalid="raise"):
        assert common_turn(values, np.ones((HARMONICS, CHANNELS)), np.full((HARMONICS, CHANNELS), 1e-12)) is None
