"""Periodic departures of the pulses of a rotor whose speed changes by itself."""

import numpy as np
import pytest

from balance_cli.signals.rotor.azimuth import azimuth_from_pulses
from balance_cli.signals.rotor.pulse_pattern import pulse_alternation, pulse_pattern, without_pattern

SPEED = 17.0


def pulses(count, late_deg=np.zeros_like, scatter_deg=0.0, seed=1):
    """Times of pulses of a rotor that becomes 5 % faster and hunts by 0.3 % meanwhile."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, 1.2 * count / SPEED, 400 * count)
    speed = SPEED * (1.0 + 0.05 * time / time[-1] + 0.003 * np.sin(0.6 * time))
    turns = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(time))])
    k = np.arange(count)
    exact = np.interp(k, turns, time)
    return exact + (late_deg(k) + scatter_deg * rng.standard_normal(count)) / 360.0 / np.interp(exact, time, speed)


@pytest.mark.parametrize("count", [30, 300])
@pytest.mark.parametrize("scatter", [0.0, 0.01, 0.3])
def test_a_smooth_rotation_has_no_pattern(count, scatter):
    times = pulses(count, scatter_deg=scatter)
    assert pulse_alternation(times, np.arange(count)) is None
    assert pulse_pattern(times, np.arange(count)) is None


@pytest.mark.parametrize("period", [3.0, 7.0, 7.37, 20.0, 40.0])
def test_a_pattern_is_found_and_taken_out_though_pulses_are_missing(period):
    def late(k):
        return 0.5 * np.sin(2 * np.pi * k / period + 0.4)

    k = np.delete(np.arange(400), [40, 41, 200, 333])
    times = pulses(400, late)[k]
    found = pulse_pattern(times, k)
    assert 1.0 / found.frequency == pytest.approx(period, rel=1e-3)
    assert found.degrees == pytest.approx(0.5, rel=0.01)
    left = without_pattern(times, k, found) - pulses(400)[k]
    assert np.abs(left).max() * 360.0 * SPEED < 0.02
    assert pulse_pattern(without_pattern(times, k, found), k, [found]) is None


@pytest.mark.parametrize(("count", "scatter"), [(14, 0.0), (400, 0.0), (400, 0.3)])
def test_pulses_that_alternate_are_averaged(count, scatter):
    even = azimuth_from_pulses(pulses(count, scatter_deg=scatter))
    odd_late = azimuth_from_pulses(pulses(count, lambda k: 3.0 * (k % 2), scatter))
    assert any("late and early in turn by 1.5 degrees" in note for note in odd_late.notes)
    assert np.degrees(odd_late.common_error) == pytest.approx(1.5, abs=0.1)
    time = np.linspace(even.first + 0.3, even.last - 0.3, 200)
    shift = np.degrees(odd_late.psi(time) - even.psi(time)) % 360.0 - 180.0
    # The first pulse, from which the azimuth counts, is that of an even one.
    assert np.abs(shift - shift.mean()).max() < 0.05 + 0.5 * scatter


def test_pulses_that_alternate_within_their_scatter_are_left():
    assert pulse_alternation(pulses(400, lambda k: 0.01 * (k % 2), 0.3), np.arange(400)) is None
