"""A tone that drifts through a harmonic is in sigma of the mean amplitude; noise and straight drifts are not."""

import numpy as np
import pytest

from balance_cli.signals.rotor.steadiness import slow_change_error

WINDOWS, SAMPLES, SIGMA = 48, 8, 1e-3


def drifting_tone(lines, place, phase):
    """Amplitudes (w, 1) of a unit tone that drifts by so many lines, and passes the harmonic at `place`."""
    share = (np.arange(WINDOWS * SAMPLES) + 0.5) / (WINDOWS * SAMPLES)
    tone = np.exp(1j * (phase + np.pi * lines * (share - place) ** 2))
    return tone.reshape(WINDOWS, SAMPLES).mean(axis=1)[:, None]


@pytest.mark.parametrize("lines", [4, 7.5, 15, 22, 45])
@pytest.mark.parametrize("place", [0.5, 0.2, 0.05])
def test_a_tone_that_drifts_through_a_harmonic_is_in_sigma(lines, place):
    z = []
    for phase in np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False):
        values = drifting_tone(lines, place, phase)
        error = np.hypot(slow_change_error(values, np.array([SIGMA]), np.array([40.0])), SIGMA)
        z.append(np.abs(values.mean().real) / error[0])
    assert max(z) < 3.0 and np.mean(z) > 0.2


@pytest.mark.parametrize("windows", [8, 12, 24, 48])
def test_noise_and_straight_drifts_leave_nothing(windows):
    rng = np.random.default_rng(windows)
    noise = rng.standard_normal((2, windows, 4000)) * SIGMA * np.sqrt(windows)
    drift = (3.0 - 2.0j) * np.linspace(0.0, 1.0, windows)[:, None]
    assert not slow_change_error(noise[0] + 1j * noise[1] + drift, np.full(4000, SIGMA), np.full(4000, 20.0)).any()
