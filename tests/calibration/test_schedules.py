"""Schedules and mistakes of laboratories: tare points, repeated rows, exchanged rows, terms of few rows."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.calibration.all_trims import calibrate_all_trims
from balance_cli.calibration.few_rows import least_p_value_without_two_rows
from balance_cli.calibration.fit import CalibrationPoints
from balance_cli.calibration.least_squares import solve_least_squares
from balance_cli.calibration.load_series import split_rows
from balance_cli.calibration.repeated_rows import merge_repeated_rows
from balance_cli.calibration.term_choice import LINEAR_TERMS
from balance_cli.campaign.rig.components import COMPONENTS

NOISE, SHIFT = 2e-4, 5e-3
STEPS = np.r_[0.2, 0.4, 0.6, 0.8, 1.0, 0.8, 0.6, 0.4, 0.2]
RANGE = np.array([800.0, 800.0, 3500.0, 400.0, 400.0, 450.0])


def schedule(first, last):
    """One load at a time with tare points at the beginning or at the end of each series, and the series."""
    values = np.r_[[0.0] * first, STEPS, [0.0] * last]
    return np.vstack([np.outer(values, one) for one in np.eye(6)]), np.repeat(np.arange(6), len(values))


def recorded(x, series, seed=0, change=lambda x, channels: None):
    """Points of one run, with a zero for each series; `change` spoils what the file holds."""
    rng = np.random.default_rng(seed)
    C = np.eye(6) + 0.1 * rng.normal(size=(6, 6))
    channels = x @ C.T + SHIFT * rng.normal(size=(series[-1] + 1, 6))[series] + NOISE * rng.normal(size=x.shape)
    x = x.copy()
    change(x, channels)
    names = tuple(f"g{i + 1}" for i in range(6))
    m = len(x)
    return C, CalibrationPoints(names, COMPONENTS, ("s",), channels, x * RANGE, np.zeros(m, int), np.ones(m), RANGE)


@pytest.mark.parametrize(("first", "last"), [(1, 0), (0, 1), (1, 1), (0, 0)])
@pytest.mark.parametrize("seed", range(3))
def test_the_readings_tell_where_the_tare_points_stand(first, last, seed):
    C, points = recorded(*(rows := schedule(first, last)), seed)
    whole = calibrate_all_trims(points, choice=LINEAR_TERMS)
    np.testing.assert_array_equal(whole.load_series, rows[1])
    np.testing.assert_allclose(whole.model.coefficients.T, C, atol=6 * NOISE)
    assert whole.outliers == ()
    assert bool(whole.series_notes) == bool(first + last)


def test_stated_series_are_taken_as_they_are():
    x, series = schedule(1, 0)
    _, points = recorded(x, series)
    stated = np.repeat(np.arange(12), 5)
    labels = tuple(str(number) for number in stated)
    np.testing.assert_array_equal(replace(points, stated_series=labels).load_series, stated)


def test_stated_tare_points_end_where_the_readings_say():
    x, series = schedule(1, 0)
    _, points = recorded(x, series)
    tare = np.all(x == 0, axis=1)
    np.testing.assert_array_equal(replace(points, tare_points=tare).load_series, series)


@pytest.mark.parametrize("without", [[20, 30], [30]])
def test_series_without_their_tare_point_beside_stated_ones(without):
    x, series = schedule(1, 0)
    _, points = recorded(x, series)
    kept = np.setdiff1d(np.arange(len(x)), without)
    points = replace(points, channels=points.channels[kept], loads=points.loads[kept], run=points.run[kept])
    points = replace(points, weight=points.weight[kept], tare_points=np.all(x[kept] == 0, axis=1))
    np.testing.assert_array_equal(points.load_series, series[kept])


def test_check_points_stand_in_the_schedule():
    """All loads of a series are check points: its tare point is no outlier of another series."""
    x, series = schedule(1, 0)
    x, series = np.vstack([x, x[20:30] * 0.5 + x[:10], x[:20]]), np.r_[series, series[:30] + 6]
    _, points = recorded(x, series)
    is_check = (series == 6) & np.any(x != 0, axis=1)
    points = replace(points, weight=np.where(is_check, 0.0, 1.0), tare_points=np.all(x == 0, axis=1))
    whole = calibrate_all_trims(replace(points, check_points=is_check), choice=LINEAR_TERMS)
    np.testing.assert_array_equal(whole.load_series, series)
    assert whole.outliers == () and whole.checks[0].applied.shape == (9, 6)


@pytest.mark.parametrize("rows", [(4, 8), (13, 44), (25, 31), (36, 38)])
@pytest.mark.parametrize("first", [0, 1])
def test_two_exchanged_rows_are_named(rows, first):
    def exchange(x, channels):
        x[list(rows)] = x[list(rows[::-1])]

    _, points = recorded(*schedule(first, 1 - first), 1, exchange)
    whole = calibrate_all_trims(points)
    found = {outlier.row: outlier.exchanged_with for outlier in whole.outliers}
    expected = {rows[0] + 1: rows[1] + 1, rows[1] + 1: rows[0] + 1}
    assert found == expected
    assert not whole.model.is_nonlinear


def test_an_outlier_in_a_series_of_five_rows_does_not_hide_in_its_own_scale():
    x = np.vstack([np.outer(np.arange(5) / 4, one) for one in np.vstack([np.eye(6), np.eye(6) * -1])])
    series = np.repeat(np.arange(12), 5)

    def spoil(x, channels):
        channels[33, 2] -= 0.03

    _, points = recorded(x, series, 2, spoil)
    whole = calibrate_all_trims(points)
    assert [(outlier.row, outlier.channel) for outlier in whole.outliers] == [(34, "g3")]
    assert whole.outliers[0].error == pytest.approx(-0.03, abs=10 * NOISE)
    assert whole.outliers[0].cause.startswith("g3 seems to read")
    assert not whole.model.is_nonlinear


def test_a_reversed_sign_is_named():
    def reverse(x, channels):
        x[15] *= -1.0

    _, points = recorded(*schedule(1, 0), 3, reverse)
    (outlier,) = calibrate_all_trims(points).outliers
    assert outlier.row == 16 and "(its sign)" in outlier.cause


@pytest.mark.parametrize("row", [4, 13, 92, 117])
def test_a_reversed_row_leaves_the_reading_of_the_series(row):
    """Two directions and pairs, each with its own tare: the reversed row must not move tare points to other series."""
    eye = np.eye(6)
    parts = [np.outer(sign * np.r_[0.0, STEPS], one) for one in eye for sign in (1, -1)]
    pairs = [np.outer([0.25, 0.5, 0.75, 1.0], eye[i]) + 0.6 * eye[(i + 1) % 6] for i in range(6)]
    parts += [np.vstack([np.zeros(6), pair]) for pair in pairs]
    x, series = np.vstack(parts), np.repeat(np.arange(18), [len(part) for part in parts])

    def reverse(x, channels):
        x[row] *= -1.0

    C, points = recorded(x, series, 1, reverse)
    whole = calibrate_all_trims(points, choice=LINEAR_TERMS)
    np.testing.assert_array_equal(whole.load_series, series)
    assert [outlier.row for outlier in whole.outliers] == [row + 1]
    np.testing.assert_allclose(whole.model.coefficients.T, C, atol=6 * NOISE)


def test_the_reversed_signs_of_all_loads_of_a_row_are_named():
    rng = np.random.default_rng(6)

    def reverse(x, channels):
        x[33] *= -1.0

    _, points = recorded(rng.uniform(-1.0, 1.0, (60, 6)), np.zeros(60, int), 3, reverse)
    (outlier,) = calibrate_all_trims(points, choice=LINEAR_TERMS).outliers
    assert outlier.row == 34 and outlier.cause == "the signs of all its loads seem to be reversed"


def test_excluded_rows_that_shorten_the_range_are_remarked():
    def spoil(x, channels):
        channels[15] += 0.05 * np.arange(6)

    _, points = recorded(*schedule(1, 0), 4, spoil)
    whole = calibrate_all_trims(points)
    assert [outlier.row for outlier in whole.outliers] == [16]
    assert whole.model.calibrated_range[1] == pytest.approx(0.8 * RANGE[1])
    assert whole.model.largest_load[1] == pytest.approx(whole.model.calibrated_range[1])
    assert any(note.startswith("Fy: the calibrated range is 640") for note in whole.screening_notes)


def test_deletion_formula_against_fits_without_two_rows():
    rng = np.random.default_rng(5)
    X, block = rng.normal(size=(14, 3)), np.repeat([0, 1], 7)
    y = X @ [1.0, 0.0, 0.3] + 0.2 * rng.normal(size=14)
    fit = solve_least_squares(X, y[:, None], block)
    worst = 0.0
    for i in range(14):
        for j in range(i):
            kept = np.setdiff1d(np.arange(14), [i, j])
            worst = max(worst, float(solve_least_squares(X[kept], y[kept, None], block[kept]).p_value[2, 0]))
    assert least_p_value_without_two_rows(fit, 2) == pytest.approx(worst, rel=1e-6)


def test_an_exchange_that_makes_neighbors_equal_is_no_repetition():
    """0.4, 0.6, 0.8, 1, 0.8, 0.6 reads 0.4, 0.8, 0.8, 1, 0.6, 0.6 with the third and sixth step exchanged."""

    def exchange(x, channels):
        x[[23, 26]] = x[[26, 23]]

    x, series = schedule(1, 0)
    _, points = recorded(x, series, 2, exchange)
    assert np.array_equal(points.loads[23], points.loads[24])
    outliers = calibrate_all_trims(points, choice=LINEAR_TERMS).outliers
    assert {(outlier.row, outlier.exchanged_with) for outlier in outliers} == {(24, 27), (27, 24)}


def test_repeated_rows_are_one_load_point_and_two_tare_points_are_two():
    x = np.outer(np.repeat([0.0, 0.5, 1.0, 0.0, 0.0, 0.5], 3), [1.0, 0.0])
    rng = np.random.default_rng(0)
    readings = 100.0 * x[:, [0]] + rng.normal(size=(18, 4))
    merged, _, repeats = merge_repeated_rows(readings, x, x, np.zeros(18, int))
    np.testing.assert_array_equal(np.flatnonzero(repeats.is_first), np.arange(0, 18, 3))
    np.testing.assert_allclose(merged[3], readings[3:6].mean(axis=0))
    assert repeats.dof == 12
    np.testing.assert_allclose(np.diag(repeats.noise_covariance(np.zeros((4, 2)))), 1 / 3, rtol=0.9)
    # Without repeated samples two unloaded rows in succession close one series and open the next.
    both = np.outer([0.0, 0.5, 1.0, 0.0, 0.0, 0.5, 1.0], [1.0, 0.0])
    assert merge_repeated_rows(both, both, both, np.zeros(7, int))[2] is None


# ---- loads in very different shares ----------------------------------------------------------------------------------


def with_small_shares(seed):
    """Series of one component each, the first of them also loaded by a fifteenth of its load beside the others."""
    x, series = schedule(1, 0)
    x[(series > 0) & np.any(x != 0, axis=1), 0] = 1.0 / 15.0
    return recorded(x, series, seed)


@pytest.mark.parametrize("seed", range(12))
def test_a_series_that_the_others_hardly_predict_is_not_excluded(seed):
    _, points = with_small_shares(seed)
    whole = calibrate_all_trims(points)
    assert whole.suspect_series == () and whole.outliers == ()
    assert set(whole.model.terms[6:]) == set(), "a family of terms that is not significant"


def test_each_direction_opens_and_closes_with_its_tare():
    """Ramps of both directions, two tare points between them: the second opens a series."""
    up = np.r_[np.arange(6), np.arange(4, -1, -1)] / 5.0
    x = np.vstack([np.outer(sign * up, np.eye(3)[j]) for j in range(3) for sign in (1.0, -1.0)])
    expected = np.repeat(np.arange(6), len(up))
    np.testing.assert_array_equal(split_rows(x, "each-return"), expected)
    np.testing.assert_array_equal(split_rows(x, "each"), expected)


def test_each_direction_closes_with_its_tare():
    """Ramps of both directions, each with its own zero, which its last row tells."""
    steps = np.r_[np.arange(1, 6), np.arange(4, -1, -1)] / 5.0
    x = np.vstack([np.outer(sign * steps, row) for row in np.eye(6) for sign in (1.0, -1.0)])
    _, points = recorded(x, series := np.repeat(np.arange(12), len(steps)))
    whole = calibrate_all_trims(points, choice=LINEAR_TERMS)
    np.testing.assert_array_equal(whole.load_series, series)
    assert whole.series_notes == ("s: each return to the tare closes a load series; the readings decide it",)
    assert whole.outliers == ()


def test_directions_whose_tare_stands_in_their_midst_are_two_series():
    """Up, to the tare, and down again; then the other direction, without a tare between them."""
    steps = np.array([0.25, 0.5, 0.75, 1.0, 0.0, 1.0, 0.75, 0.5, 0.25])
    x = np.vstack([np.outer(sign * steps, row) for row in np.eye(6) for sign in (1.0, -1.0)])
    _, points = recorded(x, series := np.repeat(np.arange(12), 9))
    whole = calibrate_all_trims(points, choice=LINEAR_TERMS)
    np.testing.assert_array_equal(whole.load_series, series)
    assert whole.series_notes == ("s: each change of sign opens a load series; the readings decide it",)
    assert whole.outliers == ()


def test_one_load_from_side_to_side_may_have_a_zero_on_each():
    """A cell hung up for tension and turned for compression, with one tare point in the midst of one ramp."""
    x = np.r_[np.arange(-8, 1), np.arange(1, 9)][:, None] / 8.0
    rng = np.random.default_rng(2)
    channels = x + 0.02 * (x > 0) + 1e-4 * rng.normal(size=x.shape)
    m = len(x)
    points = CalibrationPoints(("g",), ("Fz",), ("s",), channels, x, np.zeros(m, int), np.ones(m), np.ones(1))
    whole = calibrate_all_trims(points)
    np.testing.assert_array_equal(whole.load_series, (x[:, 0] > 0).astype(int))
    assert whole.model.terms == ("Fz",) and whole.random_terms is None
    assert np.sqrt(whole.model.residual_covariance[0, 0]) < 2e-4
    same_zero = replace(points, channels=channels - 0.02 * (x > 0))
    assert len(np.unique(calibrate_all_trims(same_zero).load_series)) == 1


@pytest.mark.parametrize("seed", range(12))
def test_nine_rows_without_labels_are_three_series(seed):
    """A tare point and two loads each: 4 of these 12 had been misread, with 10 to 50 times the residual."""
    rng = np.random.default_rng(seed)
    x, series = np.vstack([np.outer([0.0, 0.5, 1.0], row) for row in np.eye(3)]), np.repeat(np.arange(3), 3)
    C, shift = np.eye(3) + 0.1 * rng.normal(size=(3, 3)), 1e-2 * rng.normal(size=(3, 3))
    channels = x @ C + shift[series] + 3e-4 * rng.normal(size=(9, 3))
    names = tuple("abc"), ("Fx", "Fy", "Fz")
    points = CalibrationPoints(*names, ("s",), channels, x, np.zeros(9, int), np.ones(9), np.ones(3))
    whole = calibrate_all_trims(points)
    np.testing.assert_array_equal(whole.load_series, series)
    np.testing.assert_allclose(whole.model.coefficients[:3], C, atol=2e-3)
