"""Products of two loads that no load series tells: combined loads are flagged, and sigma covers what they may do."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from balance_cli.calibration.all_trims import calibrate_all_trims
from balance_cli.calibration.check_loads import HeldOutRun
from balance_cli.calibration.fit import CalibrationPoints
from balance_cli.calibration.unidentifiable_terms import _shared_variance
from balance_cli.calibration.untested_products import find_untested_products
from balance_cli.campaign.recording.channel_health import ChannelHealth
from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.reduction.mean_loads_nonlinear import nonlinear_mean_loads
from balance_cli.steps import point_loads as steps_point_loads
from balance_cli.steps.calibrate import calibrate
from balance_cli.steps.point_loads import point_loads
from balance_cli.steps.point_zeros import PointReadings
from tests.support.nonlinear_rig import NAMES, other_flags, other_flags_of_rows, spectra
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
        assert other_flags(found.flags) == ("no zero; extrapolated",) * 6
        assert "do not determine the products" in found.note and "Calibrate with combined loads" in found.note
        z.append((found.loads - loads) / found.sigma)
        without.append((found.loads - loads) / np.sqrt(variance_of_coefficients(cal, found)))
    assert np.sqrt(np.mean(np.square(z))) < 0.8 and np.mean(np.abs(z) < 1.96) > 0.95
    assert np.max(np.abs(without)) > 30.0  # what the errors of the coefficients and the noise say by themselves


def generic_readings(loads, rng_seed):
    """Readings (m, 8) with squares and products of all loads, of like size and random sign."""
    x = np.atleast_2d(loads) / AMPLITUDE
    size = 3e-3 * np.random.default_rng([rng_seed, 1]).standard_normal((6, 6, len(NAMES)))
    return x * AMPLITUDE @ C0.T + SIGNAL_RANGE * np.einsum(
        "mi,mj,ijc->mc", x, x, np.triu(np.ones((6, 6)))[..., None] * size
    )


@pytest.mark.parametrize(
    ("readings", "least"), [(lambda loads, seed: curved_readings(loads, 2), 0.3), (generic_readings, 0.5)]
)
def test_products_that_are_told_say_how_large_the_others_are(readings, least):
    """Nine of fifteen products are told: errors over sigma had been 0.18 and 0.29, rms, now 0.39 and 0.67.

    On this rig some loads reach one channel alone, which has no products of them.
    """
    steps = np.r_[np.arange(1, 6), np.arange(4, -1, -1), -np.arange(1, 6), np.arange(-4, 1)] / 5.0
    single = [np.outer(steps, load) for load in np.eye(6)]
    pairs = [(i, j) for i in range(6) for j in range(6) if (i + j) % 2]
    loads = AMPLITUDE * np.vstack([*single, *(np.outer(steps, np.eye(6)[i]) + 0.6 * np.eye(6)[j] for i, j in pairs)])
    z = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        channels = readings(loads, seed) + NOISE * rng.normal(size=(len(loads), len(NAMES)))
        cal = calibrate([Run("static", RIG.rig, "static", NAMES, len(loads), MemorySource(channels, loads))], RIG)
        for applied in 0.8 * AMPLITUDE * rng.uniform(-1, 1, (20, 6)):
            found = mean_loads(cal, readings(applied, seed)[0] + 2e-5 * rng.normal(size=len(NAMES)))
            z.append((found.loads - applied) / found.sigma)
    assert least < np.sqrt(np.mean(np.square(z))) < 1.1
    assert np.mean(np.abs(z) < 1.96) > 0.95


def variance_of_coefficients(cal, found):
    return np.diag(cal.all_trims.model.load_covariance(found.loads[None])[0])


def test_loads_like_those_applied_stay_without_flag():
    cal, rng = one_load_at_a_time(2), np.random.default_rng(4)
    for component in range(6):
        loads = 0.7 * AMPLITUDE[component] * np.eye(6)[component]
        found = mean_loads(cal, curved_readings(loads, 2)[0] + 2e-5 * rng.normal(size=len(NAMES)))
        assert other_flags(found.flags) == ("no zero",) * 6 and found.note == ""
        assert np.abs((found.loads - loads) / found.sigma).max() < 5.0


def test_tables_are_flagged_and_covered_too():
    cal, rng = one_load_at_a_time(2), np.random.default_rng(5)
    loads = 0.7 * AMPLITUDE * rng.uniform(-1, 1, (40, 6))
    loads[0] = 0.0
    channels = curved_readings(loads, 2) + NOISE * rng.normal(size=(len(loads), len(NAMES)))
    is_zero = np.arange(len(loads)) == 0
    result = point_loads(PointReadings("t", NAMES, channels, np.zeros(len(loads), np.intp), is_zero), cal)
    flags = other_flags_of_rows(result.flags)
    assert flags[0] == "" and all(flag.startswith("extrapolated F") for flag in flags[1:])
    assert np.mean(np.abs(result.loads - loads)[1:] < result.interval[1:]) > 0.95


@pytest.mark.parametrize("rows_at_once", [1, 7])
def test_each_row_of_a_table_is_as_it_is_alone(monkeypatch, rows_at_once):
    cal, rng = one_load_at_a_time(2), np.random.default_rng(6)
    channels = curved_readings(0.9 * AMPLITUDE * rng.uniform(-1, 1, (40, 6)), 2)
    channels[3, 2] += 100.0 * NOISE
    readings = PointReadings("t", NAMES, channels, np.zeros(40, np.intp), np.zeros(40, bool))
    at_once = point_loads(readings, cal)
    monkeypatch.setattr(steps_point_loads, "ROWS_AT_ONCE", rows_at_once)
    in_blocks = point_loads(readings, cal)
    for name in ("loads", "covariance", "interval", "redundancy"):
        np.testing.assert_allclose(getattr(in_blocks, name), getattr(at_once, name), rtol=1e-9)
    assert in_blocks.flags == at_once.flags
    assert at_once.redundancy[3] > 10.0 * np.median(at_once.redundancy)


def test_a_schedule_with_combined_loads_leaves_no_product_open():
    assert rig_calibration(combined=True).all_trims.untested_products is None
    one_by_one = rig_calibration(combined=False).all_trims
    names = one_by_one.untested_products.names(np.ones(6) * AMPLITUDE)
    # Every load was applied about a steady lift: the products with Fz are told.
    assert set(names) == {"Fx Fy", "Fx Mx", "Fx My", "Fx Mz", "Fy Mx", "Fy My", "Fy Mz", "Mx My", "Mx Mz", "My Mz"}


def test_a_linear_model_has_no_open_products():
    straight = rig_calibration(curved=False, combined=False).all_trims
    assert find_untested_products(straight.model, straight.loads, straight.residuals, straight.load_series) is None


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


# ---- terms that the schedule does not tell ---------------------------------------------------------------------------

LOADS = ("Fx", "Fy", "Fz", "Mx")


def drawn_points(shape, series, seed, noise=3e-4):
    """Points of a balance by chance with readings `shape` of its signals, and a check run of all loads at once."""
    rng = np.random.default_rng(seed)
    linear = np.linalg.qr(rng.standard_normal((5, 5)))[0][:4]
    x = np.vstack(series)
    number = np.repeat(np.arange(len(series)), [len(part) for part in series])
    zeros = 5e-3 * rng.standard_normal((len(series), 5))
    read = shape(x @ linear) + zeros[number] + noise * rng.standard_normal((len(x), 5))
    check = np.vstack([np.zeros((100, 4)), rng.uniform(-0.7, 0.7, (200, 4))])
    again = shape(check @ linear) + noise * rng.standard_normal((len(check), 5))
    ones, run = np.ones(len(x)), np.zeros(len(x), np.intp)
    points = CalibrationPoints(tuple("abcde"), LOADS, ("r",), read, x, run, ones, np.ones(4))
    return points, ("check", again, check)


def coverage(check):
    """Share of the loads of a check in their intervals, those of the unloaded rows left out."""
    inside = np.abs(check.computed - check.applied) <= check.prediction_interval
    return float(np.mean(inside[100:][check.is_valid[100:]]))


def hanging_series():
    """Each load up and down to both sides, then beside another one that hangs."""
    steps = np.r_[0.0, 0.25, 0.5, 0.75, 1.0, 0.5]
    single = [np.outer(side * steps, row) for row in np.eye(4) for side in (1, -1)]
    pairs = [(i, j) for i in range(4) for j in range(4) if i != j]
    beside = [np.outer(steps, np.eye(4)[i]) + 0.6 * np.eye(4)[j] for i, j in pairs]
    return single + [side * part for part in beside for side in (1, -1)]


def test_products_of_third_degree_are_in_the_intervals_where_pairs_of_loads_do_not_tell_them():
    """Signals with their cubes: before these products 55 % of the check loads were in their intervals."""
    cubes = [drawn_points(lambda s: s + 0.03 * s**3, hanging_series(), seed) for seed in range(3)]
    found = [calibrate_all_trims(points, [HeldOutRun(*run)]) for points, run in cubes]
    assert np.mean([coverage(each.checks[0]) for each in found]) > 0.92
    said = found[0].untested_products.describe(np.full(4, 0.5))
    assert "products of third degree" in said
    # Cubes of single loads leave nothing in the residuals of pairs: the intervals stay those of noise.
    points, run = drawn_points(lambda s: s, hanging_series(), 5)
    own = np.vstack([0.03 * np.eye(4), np.zeros((1, 4))]).T[:, :5]
    points = replace(points, channels=points.channels + points.loads**3 @ own)
    kept = calibrate_all_trims(points, [HeldOutRun("check", run[1] + run[2] ** 3 @ own, run[2])])
    model, untested = kept.loads_model, kept.untested_products
    assert model.is_nonlinear
    share = untested.reading_variance(run[2]).mean(axis=0) / np.diag(model.residual_covariance)
    assert np.all(share < 1.0)


def test_variances_by_chance_share_one_value_and_a_channel_beyond_chance_keeps_its_own():
    """Positive parts of each channel alone would be 0.4 sigma in the mean where there are no such products."""
    sigma, prior = np.full(8, 0.03), np.full(8, 100.0)
    drawn = 0.03 * np.random.default_rng(1).standard_normal((400, 8))
    shared = np.array([_shared_variance(row, sigma, prior) for row in drawn])
    assert shared.mean() < 0.2 * 0.03
    alone = _shared_variance(np.r_[drawn[0, :7], 2.0], sigma, prior)
    assert alone[7] == pytest.approx(2.0, rel=0.05)
    alike = _shared_variance(1.0 + drawn[0], sigma, prior)
    np.testing.assert_allclose(alike, 1.0, atol=0.1)


def test_a_variance_that_the_rows_do_not_tell_is_that_of_the_prior():
    prior = np.array([1.0, 2.0, 3.0])
    np.testing.assert_array_equal(_shared_variance(np.zeros(3), np.full(3, np.inf), prior), prior)
    np.testing.assert_allclose(_shared_variance(np.zeros(3), np.full(3, 1e3), prior), prior, rtol=1e-3)


def test_terms_that_do_the_same_in_the_schedule_are_as_likely_beyond_it():
    """Two loads that were applied together to one side: |F| G does what F G does, and the opposite elsewhere."""
    x = np.outer(np.r_[0.0, 0.25, 0.5, 0.75, 1.0], np.eye(4)[0]) + 0.6 * np.eye(4)[1]
    steps = np.r_[0.0, 0.25, 0.5, 0.75, 1.0, -0.5, -1.0]
    series = [*(np.outer(steps, row) for row in np.eye(4)), x, np.outer(x[:, 0], np.eye(4)[1]) + 0.5 * np.eye(4)[0]]
    points, _ = drawn_points(lambda s: s, series, 1)
    product = np.zeros((len(points.loads), 5))
    product[:, 2] = 0.02 * np.abs(points.loads[:, 0]) * points.loads[:, 1]
    whole = calibrate_all_trims(replace(points, channels=points.channels + product))
    aliased = whole.untested_products.aliased
    there, elsewhere = (aliased.reading_variance(np.array([row])) for row in ([0.8, 0.5, 0, 0], [-0.8, 0.5, 0, 0]))
    assert np.all(there < 1e-12)
    # The fitted term is one of four: two of these differ from it by twice the product in that quadrant.
    assert np.sqrt(elsewhere[0, 2]) == pytest.approx(2 * 0.02 * 0.8 * 0.5 / np.sqrt(2), rel=0.15)


def test_a_side_on_which_a_load_was_not_applied_may_differ_as_the_sides_of_the_others_do():
    """Two loads show |F| in every channel; of the third, which was applied to one side, its own is not known."""
    steps = np.array([0.0, 0.25, 0.5, 0.75, 1.0, 0.75, 0.5, 0.25, 0.0])
    series = [np.outer(side * steps, np.eye(3)[j]) for j in range(3) for side in (1.0, -1.0)][:-1]
    x, block = np.vstack(series), np.repeat(np.arange(5), len(steps))
    errors, sigma = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        linear, sides = np.eye(3, 4) + 0.2 * rng.normal(size=(3, 4)), 5e-3 * rng.normal(size=(3, 4))
        channels = x @ linear + np.abs(x) @ sides + 2e-3 * rng.normal(size=(5, 4))[block]
        names, m = tuple(f"g{c}" for c in range(4)), len(x)
        whole = calibrate_all_trims(
            CalibrationPoints(
                names,
                ("Fx", "Fy", "Fz"),
                ("s",),
                channels + 1e-4 * rng.normal(size=channels.shape),
                x,
                np.zeros(m, int),
                np.ones(m),
                np.ones(3),
            )
        )
        model, below = whole.loads_model, np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
        loads = model.loads(below @ linear + np.abs(below) @ sides)[0]
        variance = model.load_covariance(loads) + whole.untested_products.load_covariance(model, loads)
        errors.append(loads - below)
        sigma.append(np.sqrt(np.diagonal(variance, axis1=1, axis2=2)))
        assert np.all(whole.untested_products.aliased.reading_variance(below)[1] < 1e-12)
    ratio = np.array(errors)[:, 0] / np.array(sigma)[:, 0]
    assert 0.4 < np.sqrt(np.mean(ratio**2)) < 1.6
