"""Products of two loads that no load series tells: combined loads are flagged, and sigma covers what they may do."""

from functools import cache

import numpy as np
import pytest

from balance_cli.calibration.untested_products import find_untested_products
from balance_cli.campaign.recording.channel_health import ChannelHealth
from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.reduction.mean_loads_nonlinear import nonlinear_mean_loads
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.point_loads import point_loads
from balance_cli.steps.point_zeros import PointReadings
from tests.support.nonlinear_rig import NAMES, spectra
from tests.support.nonlinear_rig import calibration as rig_calibration
from tests.support.static_runs import AMPLITUDE, C0, RIG, loading

NOISE = 1e-4
SIGNAL_RANGE = np.max(np.abs(C0 * AMPLITUDE), axis=1)


def curved_readings(loads, power):
    """Readings (m, 8) of channels that curve with their own signal: the loads act together in their curvature."""
    signal = np.atleast_2d(loads) @ C0.T
    sign = np.where(np.arange(len(NAMES)) % 2, -1.0, 1.0)
    return signal + 0.01 * sign * SIGNAL_RANGE * (signal / SIGNAL_RANGE) ** power


@cache
def one_load_at_a_time(power):
    """A calibration by one load at a time, which finds the curvature and cannot find the products."""
    rng, loads = np.random.default_rng(11), loading()
    channels = curved_readings(loads, power) + NOISE * rng.normal(size=(len(loads), len(NAMES)))
    run = Run("static", RIG.rig, "static", NAMES, len(loads), MemorySource(channels, loads), trim="bare")
    return calibrate([run], RIG, non_iterative=power == 3)


def mean_loads(cal, volts):
    return nonlinear_mean_loads(spectra(volts, 2e-5), cal, cal.all_trims.model, ChannelHealth(NAMES, {}), None)


@pytest.mark.parametrize("power", [2, 3])
def test_combined_loads_are_flagged_and_covered(power):
    cal, rng = one_load_at_a_time(power), np.random.default_rng(4)
    z, without = [], []
    for loads in 0.7 * AMPLITUDE * rng.uniform(-1, 1, (60, 6)):
        found = mean_loads(cal, curved_readings(loads, power)[0] + 2e-5 * rng.normal(size=len(NAMES)))
        assert found.flags == ("no zero; extrapolated",) * 6
        assert "do not tell the products" in found.note and "Calibrate with combined loads" in found.note
        z.append((found.loads - loads) / found.sigma)
        without.append((found.loads - loads) / np.sqrt(variance_of_coefficients(cal, found)))
    assert np.sqrt(np.mean(np.square(z))) < 0.8 and np.mean(np.abs(z) < 1.96) > 0.95
    assert np.max(np.abs(without)) > 30.0  # what the errors of the coefficients and the noise say by themselves


def variance_of_coefficients(cal, found):
    return np.diag(cal.all_trims.model.load_covariance(found.loads[None])[0])


def test_loads_like_those_applied_stay_without_flag():
    cal, rng = one_load_at_a_time(2), np.random.default_rng(4)
    for component in range(6):
        loads = 0.7 * AMPLITUDE[component] * np.eye(6)[component]
        found = mean_loads(cal, curved_readings(loads, 2)[0] + 2e-5 * rng.normal(size=len(NAMES)))
        assert found.flags == ("no zero",) * 6 and found.note == ""
        assert np.abs((found.loads - loads) / found.sigma).max() < 5.0


def test_tables_are_flagged_and_covered_too():
    cal, rng = one_load_at_a_time(2), np.random.default_rng(5)
    loads = 0.7 * AMPLITUDE * rng.uniform(-1, 1, (40, 6))
    loads[0] = 0.0
    channels = curved_readings(loads, 2) + NOISE * rng.normal(size=(len(loads), len(NAMES)))
    is_zero = np.arange(len(loads)) == 0
    result = point_loads(PointReadings("t", NAMES, channels, np.zeros(len(loads), np.intp), is_zero), cal)
    assert result.flags[0] == "" and all(flag.startswith("extrapolated F") for flag in result.flags[1:])
    assert np.mean(np.abs(result.loads - loads)[1:] < result.interval[1:]) > 0.95


def test_a_schedule_with_combined_loads_leaves_no_product_open():
    assert rig_calibration(combined=True).all_trims.untested_products is None
    one_by_one = rig_calibration(combined=False).all_trims
    names = one_by_one.untested_products.names(np.ones(6) * AMPLITUDE)
    # Every load was applied about a steady lift: the products with Fz are told.
    assert set(names) == {"Fx Fy", "Fx Mx", "Fx My", "Fx Mz", "Fy Mx", "Fy My", "Fy Mz", "Mx My", "Mx Mz", "My Mz"}


def test_a_linear_model_has_no_open_products():
    straight = rig_calibration(curved=False, combined=False).all_trims
    assert find_untested_products(straight.model, straight.loads, straight.load_series) is None


def test_the_intervals_of_held_out_runs_are_as_wide():
    rng = np.random.default_rng(8)
    loads = np.vstack([np.zeros(6), 0.7 * AMPLITUDE * rng.uniform(-1, 1, (40, 6))])
    channels = curved_readings(loads, 2) + NOISE * rng.normal(size=(len(loads), len(NAMES)))
    held = Run("held", RIG.rig, "static", NAMES, len(loads), MemorySource(channels, loads), trim="bare")
    ramps = loading()
    volts = curved_readings(ramps, 2) + NOISE * rng.normal(size=(len(ramps), len(NAMES)))
    run = Run("static", RIG.rig, "static", NAMES, len(ramps), MemorySource(volts, ramps), trim="bare")
    for check in calibrate([run], RIG, hold_out=[held], non_iterative=True).all_trims.checks:
        assert np.min(check.interval_coverage) > 0.95
