"""Mean loads of a balance whose channels curve, in a vibration: the mean of a square is not the square of the mean."""

from dataclasses import replace

import numpy as np
import pytest

import balance_cli.reduction.vibration_shift as vibration_shift_module
from balance_cli.campaign.recording.run import MemorySource
from balance_cli.reduction.response_sources import static_source
from balance_cli.reduction.rotor_record import rotor_record
from balance_cli.reduction.vibration_shift import MOST_SAMPLES, read_deviations, vibration_shift
from balance_cli.reduction.wind_off import zero_record
from balance_cli.steps.reduce import reduce_run
from tests.support.nonlinear_rig import AMPLITUDE, NAMES, NOISE, RIG, ZERO, calibration, readings, record

LOADS = np.array([300.0, -200.0, 2000.0, 100.0, -80.0, 150.0])
SPEED = 10.0


def vibrating(share, loads=LOADS, seed=0):
    """Ten seconds in which all loads oscillate at 1/rev and 3/rev, by this share of their range."""
    run = record("w", loads, seed=seed)
    time = np.arange(run.samples) / run.sample_rate
    phase = np.arange(6.0)
    wave = np.cos(2 * np.pi * SPEED * time[:, None] + phase) + 0.5 * np.cos(
        6 * np.pi * SPEED * time[:, None] + 2 * phase
    )
    noise = NOISE * np.random.default_rng(seed).normal(size=(run.samples, len(NAMES)))
    volts = ZERO + readings(loads + share * AMPLITUDE * wave) + noise
    return replace(run, source=MemorySource(volts, None))


def mean_loads(run, cal):
    zero = zero_record(record("zero", np.zeros(6), kind="zero", seed=5), NAMES)
    found = reduce_run(run, RIG, cal, static_source(cal), zero)
    return found.amplitude[0].real, found.sigma_cosine[0], found


@pytest.mark.parametrize("share", [0.1, 0.4])
def test_mean_loads_of_a_vibration_are_those_about_which_it_oscillates(share):
    loads, sigma, _ = mean_loads(vibrating(share), calibration())
    assert np.abs((loads - LOADS) / sigma).max() < 4.0
    assert np.all(np.abs(loads - LOADS) < 3e-4 * AMPLITUDE)


def test_the_shift_is_the_mean_of_the_terms_beyond_the_loads():
    """Without it the mean loads would be off by 0.1 % of the range, many sigma of those of a steady load."""
    cal, run = calibration(), vibrating(0.4)
    model = cal.all_trims.loads_model
    deviations = read_deviations(rotor_record(run, RIG, static_source(cal)), model.channel_names)
    assert len(deviations) == pytest.approx(run.samples, rel=0.03) and len(deviations) < MOST_SAMPLES
    rows = np.arange(len(NAMES))
    shift = vibration_shift(model, rows, LOADS, deviations)
    right = readings(LOADS + 0.4 * AMPLITUDE * _waves()).mean(axis=0) - readings(LOADS)[0]
    assert shift.readings == pytest.approx(right, abs=0.03 * np.abs(right).max())
    assert np.abs(model.inverse(rows) @ right).max() > 1e-3
    assert np.abs(shift.loads) == pytest.approx(np.hypot(LOADS, 0.4 * AMPLITUDE * np.sqrt(0.625)), rel=0.02)
    assert np.all(np.sign(shift.loads) == np.sign(LOADS))


def _waves():
    turn = 2 * np.pi * np.arange(400)[:, None] / 400
    phase = np.arange(6.0)
    return np.cos(turn + phase) + 0.5 * np.cos(3 * turn + 2 * phase)


def test_a_long_record_is_sampled_at_all_azimuths(monkeypatch):
    """Every twentieth sample would have the same azimuth: the rotor turns once in 20."""
    cal, run = calibration(), vibrating(0.4)
    found = rotor_record(run, RIG, static_source(cal))
    every = read_deviations(found, NAMES)
    monkeypatch.setattr(vibration_shift_module, "MOST_SAMPLES", len(every) // 20)
    monkeypatch.setattr(vibration_shift_module, "AT_ONCE", 333)
    some = read_deviations(found, NAMES)
    assert len(some) == pytest.approx(len(every) / 20, abs=2)
    assert some.std(axis=0) == pytest.approx(every.std(axis=0), rel=0.25)


def test_a_sample_that_is_missing_leaves_the_others():
    run = vibrating(0.4)
    found = rotor_record(run, RIG, static_source(calibration()))
    volts = run.read().channels.copy()
    volts[900, 0] = np.nan
    with_gap = read_deviations(replace(found, run=replace(run, source=MemorySource(volts, None)), recorded=None), NAMES)
    assert with_gap.std(axis=0) == pytest.approx(read_deviations(found, NAMES).std(axis=0), rel=1e-2)


def test_a_channel_that_is_dead_has_no_deviation():
    cal, run = calibration(), vibrating(0.4)
    volts = run.read().channels.copy()
    volts[:, NAMES.index("z3.strain")] = 0.0
    loads, sigma, found = mean_loads(replace(run, source=MemorySource(volts, None)), cal)
    assert "z3.strain" in found.left_out
    assert np.abs((loads - LOADS) / sigma).max() < 4.0


def test_products_that_were_not_tested_are_those_of_the_loads_that_a_vibration_reaches():
    cal = calibration(combined=False)
    still, shaken = (mean_loads(vibrating(share, 0.1 * LOADS), cal)[1] for share in (0.0, 0.5))
    assert np.median(shaken / still) > 3.0


def test_what_a_model_has_taken_out_is_not_taken_off_again():
    cal, run = calibration(), vibrating(0.4)
    found = rotor_record(run, RIG, static_source(cal))
    assert read_deviations(replace(found, recorded=run), NAMES) is not None
    assert read_deviations(replace(found, recorded=record("w", LOADS)), NAMES) is None
