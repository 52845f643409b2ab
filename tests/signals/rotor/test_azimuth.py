import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from balance_cli.io.errors import UserError
from balance_cli.signals.rotor.azimuth import azimuth_from_pulses
from balance_cli.signals.rotor.pulse_resolution import timing_step

RATE = 17.5


def revolutions(time, drift=0.04, period=20.0):
    """Count of revolutions at a speed that drifts by `drift` about RATE, and the speed."""
    omega = 2 * np.pi / period
    count = RATE * (time + drift * (1 - np.cos(omega * time)) / omega)
    return count, RATE * (1 + drift * np.sin(omega * time))


def pulses(duration=20.0, drift=0.04):
    """Pulse times, by bisection on the count."""
    time = np.linspace(0, duration, 200_001)
    count, _ = revolutions(time, drift)
    target = np.arange(1, int(count[-1]))
    times = np.interp(target, count, time)
    for _ in range(5):
        value, speed = revolutions(times, drift)
        times = times - (value - target) / speed
    return times


def test_azimuth_and_speed_of_a_drifting_rotor():
    times = pulses()
    azimuth = azimuth_from_pulses(times)
    time = np.linspace(times[0], times[-1], 9999)
    count, speed = revolutions(time)
    np.testing.assert_allclose(azimuth.psi(time) / (2 * np.pi), count - 1, atol=2e-10)
    np.testing.assert_allclose(azimuth.speed(time), speed, rtol=1e-7)
    assert azimuth.notes == ()
    assert azimuth.mean_rate == pytest.approx((len(times) - 1) / (times[-1] - times[0]), rel=1e-14)
    np.testing.assert_allclose(azimuth.psi(times), 2 * np.pi * np.arange(len(times)), atol=1e-9)


def test_outside_the_pulses_there_is_no_azimuth():
    azimuth = azimuth_from_pulses(pulses())
    outside = [azimuth.first - 1e-6, azimuth.last + 1e-6]
    assert np.all(np.isnan(azimuth.psi(outside))) and np.all(np.isnan(azimuth.speed(outside)))


def test_time_of_inverts_the_count():
    azimuth = azimuth_from_pulses(pulses())
    revolution = np.linspace(0, azimuth.turns, 777)
    np.testing.assert_allclose(azimuth.psi(azimuth.time_of(revolution)) / (2 * np.pi), revolution, atol=1e-10)


@settings(max_examples=40, deadline=None)
@given(
    missing=st.sets(st.integers(10, 300).map(lambda k: 8 * (k // 8)), max_size=5),
    doubled=st.sets(st.integers(10, 300).map(lambda k: 8 * (k // 8) + 4), max_size=5),
    offset=st.floats(0.002, 0.7),
)
def test_missing_and_stray_pulses_are_repaired_and_said(missing, doubled, offset):
    sound = pulses()
    strays = [sound[k] + offset * (sound[k + 1] - sound[k]) for k in doubled]
    azimuth = azimuth_from_pulses(np.sort(np.concatenate([np.delete(sound, list(missing)), strays])))
    time = np.linspace(sound[0], sound[-1], 5000)
    # A stray so close that either of the two may be the true one leaves its own distance as error.
    tolerance = 1e-6 if offset > 0.05 or not doubled else 1.5 * offset
    np.testing.assert_allclose(azimuth.psi(time) / (2 * np.pi), revolutions(time)[0] - 1, atol=tolerance)
    assert azimuth.turns == len(sound) - 1
    assert len(azimuth.notes) == len(missing) + len(doubled)


def test_a_mistimed_pulse_is_dropped_and_said():
    times = pulses()
    late = times.copy()
    late[100] += 0.1 / RATE
    azimuth = azimuth_from_pulses(late)
    assert len(azimuth.notes) == 1 and "mistimed" in azimuth.notes[0]
    np.testing.assert_allclose(azimuth.psi(times[90:110]), 2 * np.pi * np.arange(90, 110), atol=1e-6)


def test_jitter_of_a_twentieth_of_a_degree_is_kept_as_it_is():
    times = pulses()
    jittered = times + np.random.default_rng(1).normal(size=len(times)) * 0.05 / 360 / RATE
    azimuth = azimuth_from_pulses(jittered)
    assert azimuth.notes == ()
    assert np.degrees(azimuth.pulse_scatter) == pytest.approx(0.05, rel=0.2)
    np.testing.assert_allclose(azimuth.psi(jittered), 2 * np.pi * np.arange(len(times)), atol=1e-9)


@pytest.mark.parametrize(
    ("spoil", "word"),
    [
        (lambda t: t[:2], "only 2 pulses"),
        (lambda t: np.where(np.arange(len(t)) == 7, np.nan, t), "entry 7"),
        (lambda t: np.where(np.arange(len(t)) == 7, t[5], t), "decrease"),
        (lambda t: np.concatenate([t[:50], t[50:] + 0.5 / RATE]), "cannot be repaired"),
        (lambda t: np.delete(t, slice(100, 120)), "cannot be repaired"),
        (lambda t: np.delete(t, slice(None, None, 4)), "too many"),
        (lambda t: np.concatenate([t[0] - np.cumsum(1.6 ** np.arange(1, 6))[::-1] / RATE, t]), "changes its speed"),
    ],
)
def test_what_cannot_be_repaired_is_refused(spoil, word):
    with pytest.raises(UserError, match=word):
        azimuth_from_pulses(spoil(pulses()))


@pytest.mark.parametrize("late", [np.floor, np.ceil])
@pytest.mark.parametrize("drift", [1e-6, 1e-3, 0.04])
def test_pulses_timed_in_whole_samples_are_smoothed_and_say_that_they_may_be_late(drift, late):
    """Steps of 12.6 degrees: slow beats with the revolution are no changes of speed, and half a step stays unknown."""
    times, step = pulses(drift=drift), 1 / 500
    azimuth = azimuth_from_pulses(late(times / step) * step)
    (note,) = azimuth.notes
    assert "in steps of 2 ms" in note and "off by half of it, 6.3 degrees" in note
    error = np.degrees(azimuth.psi(times[12:-12]) - 2 * np.pi * np.arange(12, len(times) - 12))
    assert error.std() < 1.3 < 0.3 * 360 * RATE * step
    assert np.degrees(azimuth.common_error) == pytest.approx(360 * RATE * step / np.sqrt(12), rel=1e-3)
    # Half a step is 1.73; where the pulses meet seven phases of a sample only, the mean is an eighth from it.
    assert 1.4 < abs(error.mean()) / np.degrees(azimuth.common_error) < 2.0


@pytest.mark.parametrize("kind", [float, np.float32])
def test_the_step_of_pulse_times_is_told_and_none_where_there_is_none(kind):
    times = pulses()
    for step in (1 / 500, 1 / 1024, 1e-3):
        assert timing_step((np.rint(times / step) * step).astype(kind).astype(float)) == pytest.approx(step, rel=1e-6)
    rng = np.random.default_rng(0)
    free = [np.cumsum(0.05 * (1 + 0.01 * rng.standard_normal(rng.integers(12, 60)))) for _ in range(200)]
    assert not any(timing_step(t.astype(kind).astype(float)) for t in [times, *free])
    assert timing_step(np.arange(40) / RATE) == 0.0
    assert timing_step(np.delete(np.arange(40), [5, 20, 21]) / RATE) == 0.0


@pytest.mark.parametrize(("scatter", "left"), [(5.0, 2.5), (0.5, 0.25)])
def test_pulses_that_scatter_are_smoothed(scatter, left):
    times = pulses()
    jittered = np.sort(times + np.random.default_rng(1).normal(size=len(times)) * scatter / 360 / RATE)
    missing = np.delete(jittered, [30, 31, 77])
    azimuth = azimuth_from_pulses(missing)
    assert "smoothed over" in azimuth.notes[-1] and azimuth.turns == len(times) - 1
    error = np.degrees(azimuth.psi(times[1:-1]) - 2 * np.pi * np.arange(1, len(times) - 1))
    assert error.std() < left and np.degrees(azimuth.pulse_scatter) == pytest.approx(scatter, rel=0.2)
    assert error.std() < 1.3 * np.degrees(azimuth.local_error)


@pytest.mark.parametrize("most_kept", [0, 2**20])
def test_azimuth_of_samples_is_that_of_their_times_and_beyond_the_pulses_that_of_the_nearest(monkeypatch, most_kept):
    monkeypatch.setattr("balance_cli.signals.rotor.azimuth.MOST_KEPT", most_kept)
    azimuth = azimuth_from_pulses(pulses()[3:])
    for start, stop in ((0, 900), (700, 17_000), (0, 16_500)):
        time = np.clip(np.arange(start, stop) / 800.0, azimuth.first, azimuth.last)
        psi, speed = azimuth.of_samples(800.0, start, stop)
        np.testing.assert_array_equal(psi, azimuth.psi(time))
        np.testing.assert_array_equal(speed, azimuth.speed(time))
