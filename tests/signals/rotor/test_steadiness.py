import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.signals.rotor.azimuth import azimuth_from_pulses
from balance_cli.signals.rotor.steadiness import unsteady, windowed_amplitudes

WINDOWS = 48


def test_noise_alone_is_steady():
    rng = np.random.default_rng(1)
    values = rng.standard_normal((WINDOWS, 20000)) + 1j * rng.standard_normal((WINDOWS, 20000))
    assert unsteady(values, np.zeros(20000)).sum() <= 1


def test_gusts_that_outlast_a_window_are_steady():
    rng = np.random.default_rng(2)
    noise = rng.standard_normal((WINDOWS + 50, 2000))
    for row in range(1, len(noise)):
        noise[row] += 0.4 * noise[row - 1]
    # The stated uncertainty of the mean of such a series.
    sigma = np.full(2000, noise[50:].std() * np.sqrt((1 + 0.4) / (1 - 0.4) / WINDOWS))
    assert unsteady(noise[50:].astype(complex), sigma).mean() <= 2e-3


@pytest.mark.parametrize("place", [8, 24, 40])
@pytest.mark.parametrize("part", [1.0, 1j])
def test_a_step_is_found_wherever_it_is(place, part):
    rng = np.random.default_rng(3)
    values = rng.standard_normal((WINDOWS, 200)) + 1j * rng.standard_normal((WINDOWS, 200))
    values[place:] += 6.0 * part
    assert unsteady(values, np.full(200, 1 / np.sqrt(WINDOWS))).mean() > 0.95


def test_a_drift_is_found_and_what_sigma_covers_is_not():
    rng = np.random.default_rng(4)
    values = (rng.standard_normal((WINDOWS, 200)) + np.linspace(-4, 4, WINDOWS)[:, None]).astype(complex)
    assert unsteady(values, np.full(200, 1 / np.sqrt(WINDOWS))).mean() > 0.95
    assert not unsteady(values, np.full(200, 4.0)).any()


def test_a_short_series_says_nothing():
    assert not unsteady(np.arange(7.0).reshape(7, 1).astype(complex), np.zeros(1)).any()


def test_windows_hold_the_amplitudes_of_their_part_of_the_record():
    rate, speed, duration = 600.0, 9.0, 30.0
    time = np.arange(int(rate * duration)) / rate
    turns = speed * time + 0.4 * np.sin(2 * np.pi * time / 20.0)
    size = np.where(time < 15.0, 1.0, 1.5)
    channels = np.column_stack([2.0 + size * np.cos(4 * np.pi * turns + 0.3), np.sin(2 * np.pi * turns)])
    pulses = np.interp(np.arange(int(turns[-1]) + 1), turns, time)
    run = Run(
        "w", "rig", "wind", ("a", "b"), len(time), MemorySource(channels, None), sample_rate=rate, pulse_times=pulses
    )  # fmt: skip
    azimuth = azimuth_from_pulses(run.pulse_times)
    windows = windowed_amplitudes(run, azimuth, ("a", "b"), 3, (0, azimuth.turns))
    np.testing.assert_allclose(windows.values[:20, 0, 0], 2.0, atol=1e-3)
    np.testing.assert_allclose(np.abs(windows.values[:20, 2, 0]), 1.0, atol=1e-3)
    np.testing.assert_allclose(np.abs(windows.values[-20:, 2, 0]), 1.5, atol=1e-3)
    np.testing.assert_allclose(np.angle(windows.values[:20, 2, 0]), 0.3, atol=2e-3)
    np.testing.assert_allclose(windows.values[:, 1, 1], -1j, atol=1e-3)
    assert windows.speed.mean() == pytest.approx(speed, rel=0.01)
