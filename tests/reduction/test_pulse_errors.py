"""Periodic departures of the pulses: the channels tell errors of the pulses from a speed that changes."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.campaign.recording.additions import RunAdditions
from balance_cli.reduction.flags import NOT_STEADY
from balance_cli.reduction.model_sources import ModelSource
from balance_cli.steps.reduce import reduce_run
from tests.reduction.test_speed_modulation import RIG, harmonics, source  # noqa: F401
from tests.support.wind_record import wind_record

SPEED = RIG.rotor.speed


def reduced(source: ModelSource, late_deg, speed_change=np.zeros_like):  # noqa: F811
    """Return the largest error over sigma of a record whose pulses are late, and its loads."""
    record = wind_record(RIG, harmonics(), rate=500.0, seconds=14.0, speed_change=speed_change)
    times = record.run.pulse_times
    late = late_deg(np.arange(len(times))) / 360.0 / SPEED
    loads = reduce_run(replace(record.run, pulse_times=times + late), RIG, None, source)
    error = (loads.amplitude - record.loads)[1:]
    sigma = np.stack([loads.sigma_cosine, loads.sigma_sine])[:, 1:]
    return float(np.abs(np.stack([error.real, error.imag]) / sigma).max()), loads


def modulated(degrees, period):
    return lambda k: degrees * np.sin(2 * np.pi * k / period + 0.3)


def hunting(degrees, period):
    """A speed that makes the azimuth lead and lag by so much."""
    amplitude = np.radians(degrees) / period
    return lambda time: amplitude * np.cos(2 * np.pi * SPEED / period * time)


@pytest.mark.parametrize(("degrees", "period"), [(3.0, 7.0), (0.3, 7.0), (3.0, 20.0)])
def test_errors_of_the_pulses_are_taken_out(source, degrees, period):  # noqa: F811
    error, loads = reduced(source, modulated(degrees, period))
    assert error < 4.0
    assert any("the channels are not, taken out" in note for note in loads.notes)


def test_a_speed_that_hunts_is_kept(source):  # noqa: F811
    error, loads = reduced(source, np.zeros_like, hunting(3.0, 7.0))
    assert error < 4.0
    assert not any("taken out" in note for note in loads.notes)
    assert not any(NOT_STEADY in flag for row in loads.flags for flag in row)


def test_a_doubt_that_changes_no_load_flags_none(source):  # noqa: F811
    error, loads = reduced(source, modulated(0.09, 7.0), hunting(0.4, 7.0))
    assert error < 4.0
    assert not any(NOT_STEADY in flag for row in loads.flags for flag in row)


def test_pulses_that_alternate_have_an_azimuth_within_sigma(source):  # noqa: F811
    error, loads = reduced(source, lambda k: 3.0 * (k % 2))
    assert error < 2.0
    assert any("late and early in turn by 1.5 degrees" in note for note in loads.notes)


def test_an_error_of_the_pulses_on_a_speed_that_hunts_alike_is_not_trusted(source):  # noqa: F811
    _, loads = reduced(source, modulated(3.0, 7.0), hunting(3.0, 7.0))
    assert all(NOT_STEADY in flag for row in loads.flags[1:] for flag in row)


def test_the_error_of_azimuth_that_an_import_states_is_in_sigma(source):  # noqa: F811
    """Pulses that an import has smoothed are all late alike for tens of revolutions, and show no scatter."""
    record = wind_record(RIG, harmonics(), rate=500.0, seconds=14.0)
    drifting = record.run.pulse_times + 0.3 / 360.0 / SPEED * np.cos(
        np.pi * np.arange(len(record.run.pulse_times)) / 400
    )
    outside = []
    for additions in (None, RunAdditions(azimuth_error_deg=0.3)):
        loads = reduce_run(replace(record.run, pulse_times=drifting, additions=additions), RIG, None, source)
        error = (loads.amplitude - record.loads)[1:]
        sigma = np.stack([loads.sigma_cosine, loads.sigma_sine])[:, 1:]
        outside.append(np.mean(np.abs(np.stack([error.real, error.imag])) > 1.96 * sigma))
    assert outside[0] > 0.5
    assert outside[1] < 0.05
