import tracemalloc

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.signals.rotor import steadiness
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


@pytest.mark.parametrize(("count", "place"), [(10, 4), (11, 6)])
@pytest.mark.parametrize("part", [1.0, 1j])
def test_a_step_is_found_in_a_dozen_windows_one_of_which_it_divides(count, place, part):
    rng = np.random.default_rng(6)
    shape = np.where(np.arange(count) > place, 20.0, 0.0) + np.where(np.arange(count) == place, 9.0, 0.0)
    values = 100.0 + part * (shape[:, None] + 0.1 * rng.standard_normal((count, 200)))
    assert unsteady(values.astype(complex), np.full(200, 1.5)).all()


@pytest.mark.parametrize("correlation", [0.0, 0.8])
@pytest.mark.parametrize("count", [10, 12, 23])
def test_few_windows_of_gusts_are_steady(count, correlation):
    rng = np.random.default_rng(7)
    noise = rng.standard_normal((count, 20000))
    noise[0] /= np.sqrt(1.0 - correlation**2)
    for row in range(1, count):
        noise[row] += correlation * noise[row - 1]
    assert unsteady(noise.astype(complex), np.zeros(20000), correlation).sum() <= 2
    paired = noise[:, :10000] + 1j * noise[:, 10000:]
    assert unsteady(paired, np.zeros(10000), correlation).sum() <= 2


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


@pytest.mark.parametrize("count", [10, 16, 25])
def test_few_windows_tell_a_clear_step_and_raise_no_alarm_by_chance(count):
    rng = np.random.default_rng(count)
    noise = rng.standard_normal((count, 20000)) + 1j * rng.standard_normal((count, 20000))
    assert unsteady(noise, np.zeros(20000)).sum() <= 1
    stepped = noise[:, :100].copy()
    stepped[count // 2 :] += 30.0
    assert unsteady(stepped, np.full(100, 1.0)).mean() > 0.95


@pytest.mark.parametrize("periods", [1, 2])
def test_a_slow_sine_and_a_burst_are_found(periods):
    rng = np.random.default_rng(7)
    noise = 0.1 * rng.standard_normal((WINDOWS, 100))
    place = np.arange(WINDOWS)[:, None] / WINDOWS
    sine = np.sin(2 * np.pi * periods * place + 0.5)
    burst = 2.0 * ((place > 0.4) & (place < 0.55))
    for change in (sine, burst):
        assert unsteady((noise + change).astype(complex), np.full(100, 0.02)).mean() > 0.95


def test_a_mode_that_outlasts_its_windows_is_no_drift():
    rng = np.random.default_rng(8)
    noise = rng.standard_normal((WINDOWS + 200, 2000))
    for row in range(1, len(noise)):
        noise[row] += 0.85 * noise[row - 1]
    values = noise[200:].astype(complex)
    assert unsteady(values, np.zeros(2000)).mean() > 0.1
    assert unsteady(values, np.zeros(2000), 0.85).mean() <= 2e-3


@pytest.mark.parametrize("degrees", [0.0, 30.0, 45.0, 90.0, 200.0])
def test_the_size_of_a_change_does_not_depend_on_its_phase(degrees):
    rng = np.random.default_rng(6)
    noise = 0.02 * (rng.standard_normal((WINDOWS, 50)) + 1j * rng.standard_normal((WINDOWS, 50)))
    values = noise + (np.arange(WINDOWS) > 0.6 * WINDOWS)[:, None] * np.exp(1j * np.radians(degrees))
    assert unsteady(values, np.full(50, 0.9 / 3.0)).all()
    assert not unsteady(values, np.full(50, 1.1 / 3.0)).any()


def test_the_memory_of_windows_does_not_grow_with_the_record(monkeypatch):
    pulses, rate = np.arange(400) / 10.0, 500.0
    samples = int(pulses[-1] * rate)
    signals = np.random.default_rng(8).standard_normal((samples, 6))
    source = MemorySource(signals, None)
    run = Run("w", "r", "wind", tuple("abcdef"), samples, source, False, rate, 10.0, pulse_times=pulses)
    azimuth = azimuth_from_pulses(pulses)
    given = run, azimuth, run.channel_names, 8, (3, 399)
    together = windowed_amplitudes(*given)
    monkeypatch.setattr(steadiness, "WINDOWED_SAMPLES", 2000)
    tracemalloc.start()
    np.testing.assert_array_equal(windowed_amplitudes(*given).values, together.values)
    assert tracemalloc.get_traced_memory()[1] < signals.nbytes
    tracemalloc.stop()
