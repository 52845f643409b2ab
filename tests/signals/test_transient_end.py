import numpy as np
import pytest
import scipy.signal

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.signals.rotor.azimuth import azimuth_from_pulses
from balance_cli.signals.transient_end import find_transient_end

SAMPLE_RATE, RATE = 800.0, 17.5
NOISE = 1e-3


def record(duration=20.0, drift=0.0):
    """Time, azimuth object and azimuth at the samples, with a speed that moves by `drift`."""
    time = np.arange(int(duration * SAMPLE_RATE)) / SAMPLE_RATE
    omega = 2 * np.pi / 12.0

    def count(t):
        return RATE * (t + drift * (1 - np.cos(omega * t)) / omega)

    fine = np.linspace(0, duration, 500_001)
    azimuth = azimuth_from_pulses(np.interp(np.arange(1, int(count(duration))), count(fine), fine))
    return time, azimuth, 2 * np.pi * (count(time) - 1)


def run_of(channels):
    names = tuple(f"c{k}" for k in range(channels.shape[1]))
    source = MemorySource(channels, None)
    return Run("r", "rig", "wind", names, len(channels), source, False, SAMPLE_RATE, RATE)


def transient_end(channels, azimuth, limit):
    """The time [s] of the first steady revolution."""
    run = run_of(channels)
    return float(azimuth.time_of(np.array(find_transient_end(run, azimuth, limit, run.channel_names))))


def noise(time, seed=0, channels=6):
    return NOISE * np.random.default_rng(seed).normal(size=(len(time), channels))


def decay(time, amplitude, rate, frequency):
    return amplitude * np.exp(-rate * time) * np.cos(2 * np.pi * frequency * time)


@pytest.mark.parametrize("seed", range(5))
def test_a_steady_record_keeps_its_beginning(seed):
    time, azimuth, psi = record(drift=0.01)
    end = transient_end(np.cos(4 * psi)[:, None] + noise(time, seed), azimuth, 8.0)
    assert end == azimuth.first


def light_modes(time, seed):
    """Eight channels of four modes of damping ratio 0.02 that white noise moves since long before the record."""
    rng = np.random.default_rng(seed)
    before = 2000
    modes = []
    for frequency in (14.1, 26.3, 38.7, 61.2):
        w = 2 * np.pi * frequency / SAMPLE_RATE
        poles = np.poly(np.exp([-0.02 * w + 1j * w, -0.02 * w - 1j * w])).real
        modes.append(scipy.signal.lfilter([1.0], poles, rng.normal(size=before + len(time)))[before:])
    return np.array(modes).T @ rng.normal(size=(4, 8))


def test_gusts_that_shake_light_modes_leave_a_record_its_beginning():
    """A tenth of the revolutions had been left out on average, up to 36 of 60."""
    ends = []
    for seed in range(40):
        time, azimuth, psi = record(3.5)
        run = run_of(light_modes(time, seed) + 100.0 * np.cos(psi)[:, None])
        ends.append(find_transient_end(run, azimuth, 1e9, run.channel_names))
    assert np.mean(ends) < 3.5 and np.quantile(ends, 0.9) <= 12.0


def test_a_start_is_found_beside_gusts():
    for seed in range(10):
        time, azimuth, _ = record(3.5)
        x = light_modes(time, seed)
        size = x.std(axis=0).max()
        x[:, 3] += decay(time, 50.0 * size, 3.0, 31.0)
        end = float(azimuth.time_of(np.array(find_transient_end(run_of(x), azimuth, 1e9, run_of(x).channel_names))))
        assert 50.0 * np.exp(-3.0 * end) < 5.0


@pytest.mark.parametrize("frequency", [26.3, 35.6, 70.4])
def test_a_mode_that_rings_is_waited_for_until_it_is_in_the_noise(frequency):
    time, azimuth, psi = record()
    x = np.cos(psi)[:, None] + noise(time)
    x[:, 2] += decay(time, 1.0, 1.2, frequency)
    end = transient_end(x, azimuth, 10.0)
    remainder = np.exp(-1.2 * end)
    # A mode on a harmonic shows by its decay alone: 1 - exp(-1.2 * 4 / 17.5), a quarter of it.
    assert 0.2 * NOISE < remainder < 5 * NOISE


def test_the_slow_decay_of_a_high_pass_shows_but_little():
    time, azimuth, psi = record()
    x = np.cos(psi)[:, None] + noise(time)
    x[:, 1] += np.exp(-time / 3.0)
    end = transient_end(x, azimuth, 14.0)
    assert end < 14.0 and np.exp(-end / 3.0) < 20 * NOISE


def test_a_transient_beyond_the_limit_ends_at_the_limit():
    time, azimuth, psi = record()
    end = transient_end((np.cos(psi) + decay(time, 1.0, 0.1, 26.3))[:, None] + noise(time), azimuth, 3.0)
    assert 3.0 <= end < 3.0 + 1 / RATE


def test_a_manoeuvre_with_a_step_late_in_the_record_costs_nothing():
    time, azimuth, psi = record(30.0, drift=0.03)
    load = np.where(time < 12.0, 1.0, 0.3)
    response = (1 + 0.2 * np.cos(2 * np.pi * time / 12.0)) * load * np.cos(4 * psi)
    x = (load + response)[:, None] + noise(time)
    x[:, 0] += decay(time, 1.0, 2.0, 26.3)
    end = transient_end(x, azimuth, 15.0)
    assert end < 6.0


def test_at_least_a_quarter_is_never_discarded():
    time, azimuth, psi = record(20.0)
    end = transient_end(np.cos(psi)[:, None] * np.exp(-0.05 * time)[:, None] + noise(time), azimuth, 1e9)
    assert end <= azimuth.time_of(np.array(0.75 * azimuth.turns))


def test_a_computed_record_without_noise_settles_too():
    time, azimuth, psi = record()
    x = (np.cos(psi) + decay(time, 1.0, 2.0, 26.3))[:, None]
    end = transient_end(x, azimuth, 12.0)
    assert end < 12.0 and np.exp(-2.0 * end) < 1e-3
