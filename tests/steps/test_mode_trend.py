"""Eigenfrequencies that turbulence shows between the harmonics, against oscillators in closed form."""

import numpy as np
import pytest

from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.io.errors import UserError
from balance_cli.model.balance import balance_model
from balance_cli.model.system_response import response, solve
from balance_cli.steps.mode_trend import mode_trends, run_modes
from tests.steps.test_trend import a_point
from tests.support.rigs import two_degrees_of_freedom

RATE, SPEED, DURATION = 256.0, 11.0, 20.0
MASS, PITCH_INERTIA, STIFFNESS, ARM, DAMPING = 20.0, 0.8, 1e6, 0.3, 0.02
SENSITIVITY, NOISE = 0.002, 1e-3
HEAVE, PITCH = (
    np.sqrt(2 * STIFFNESS / MASS) / (2 * np.pi),
    np.sqrt(2 * STIFFNESS * ARM**2 / PITCH_INERTIA) / (2 * np.pi),
)
MODES = np.sort([HEAVE, PITCH])
GEOMETRY = two_degrees_of_freedom()


class Declared:
    """The response of the rig as declared."""

    def __init__(self):
        self.system, self.slowest_decay, self.untrusted_channels = balance_model(GEOMETRY).system(), 0.2, {}

    def remove_nonlinear_contribution(self, run, live):
        return run

    def at(self, frequency, spin):
        return response(self.system, solve(self.system, frequency))


DECLARED = Declared()


def a_record(seed, stiffness=1.0, turbulence=1.0, tone=None):
    """Heave and pitch under white loads, exact at the samples of a record that repeats itself; harmonics, noise."""
    rng = np.random.default_rng(seed)
    count = int(DURATION * RATE)
    time, omega = np.arange(count) / RATE, 2 * np.pi * np.fft.rfftfreq(count, 1 / RATE)
    motion = []
    for inertia, spring, load in (
        (MASS, 2 * STIFFNESS * stiffness, 20.0),
        (PITCH_INERTIA, 2 * STIFFNESS * stiffness * ARM**2, 4.0),
    ):
        natural = np.sqrt(spring / inertia)
        force = np.fft.rfft(turbulence * load * rng.standard_normal(count))
        motion.append(np.fft.irfft(force / (inertia * (natural**2 - omega**2 + 2j * DAMPING * natural * omega)), count))
    speed = SPEED * (1 + 0.002 * rng.standard_normal())
    harmonics = sum(np.cos(2 * np.pi * n * speed * time + n) for n in range(1, 9))
    force = stiffness * STIFFNESS * np.stack([motion[0] - ARM * motion[1], motion[0] + ARM * motion[1]], axis=1)
    volts = SENSITIVITY * force + 0.2 * harmonics[:, None] + NOISE * rng.standard_normal((count, 2))
    if tone:
        volts += 0.5 * np.sin(2 * np.pi * tone * time)[:, None]
    pulses = np.arange(0.0, DURATION - 0.01, 1 / speed)
    return Run(
        *(f"r{seed}", "ONE", "wind", GEOMETRY.channel_names, count, MemorySource(volts, None)),
        has_loads=False,
        sample_rate=RATE,
        rotor_speed=SPEED,
        pulse_times=pulses,
    )


def a_run_point(seed, run):
    rate = (len(run.pulse_times) - 1) / np.ptp(run.pulse_times)
    return a_point(seed, np.random.default_rng(seed), speed=rate)


def followed(seeds, **truth):
    """Points and modes of the records of these seeds; `truth` holds a function of the seed for each argument."""
    points, modes = [], {}
    for seed in seeds:
        run = a_record(seed, **{name: of(seed) for name, of in truth.items()})
        points.append(a_run_point(seed, run))
        modes[run.name] = run_modes(run, points[-1], GEOMETRY, DECLARED)
    return points, modes


def trends_of(points, modes):
    place = np.arange(len(points), dtype=float)
    return mode_trends(points, modes, place, np.array([point.speed for point in points]))


@pytest.fixture(scope="module")
def unchanged():
    return followed(range(32))


def test_frequencies_lie_within_their_sigma_without_bias(unchanged):
    _, modes = unchanged
    z = np.array([(item.frequency - MODES) / item.sigma for item in modes.values()])
    assert np.isfinite(z).mean() > 0.97
    assert np.nanstd(z, axis=0) == pytest.approx([1.0, 1.0], abs=0.25)
    assert np.abs(np.nanmean(z, axis=0)).max() < 3.0 / np.sqrt(len(z))
    assert next(iter(modes.values())).predicted == pytest.approx(MODES, rel=1e-6)


def test_an_unchanged_rig_does_not_drift(unchanged):
    points, modes = unchanged
    for part in (points, points[:16], points[16:]):
        trends = trends_of(part, modes)
        assert not any(trend.is_significant for trend in trends)
        assert all(abs(trend.departure) < 4 * trend.sigma_departure for trend in trends)


def test_a_stiffness_that_changes_by_three_percent_amid_a_campaign_is_found(unchanged):
    before, modes = unchanged
    after, changed = followed(range(100, 116), stiffness=lambda seed: 1.03)
    trends = trends_of([*before[:16], *after], {**modes, **changed})
    for trend in trends:
        assert trend.is_significant and trend.change > 0
        assert trend.last - trend.first == pytest.approx(np.sqrt(1.03) - 1.0, abs=0.004)


def test_without_turbulence_nothing_is_said_of_modes():
    points, modes = followed(range(200, 208), turbulence=lambda seed: 0.0)
    assert all(np.isnan(item.frequency).all() for item in modes.values())
    assert [trend.runs for trend in trends_of(points, modes)] == [0, 0]


def test_a_tone_beside_a_mode_is_not_taken_for_it():
    _, modes = followed(range(300, 304), tone=lambda seed: 1.015 * MODES[0])
    z = np.array([(item.frequency - MODES) / item.sigma for item in modes.values()])
    assert np.isfinite(z).all() and np.abs(z).max() < 4.0


def test_another_recording_of_the_same_name_is_refused():
    run = a_record(1)
    with pytest.raises(UserError, match="the loads of `r1` are at 12 Hz"):
        run_modes(run, a_point(1, np.random.default_rng(1), speed=12.0), GEOMETRY, DECLARED)
