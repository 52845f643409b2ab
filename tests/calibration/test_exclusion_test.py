"""Good rows of short tables are not called outliers because some of the others lie on a line by chance."""

import numpy as np
import pytest

from balance_cli.calibration.all_trims import calibrate_all_trims
from balance_cli.calibration.fit import CalibrationPoints
from balance_cli.calibration.outliers import screen_outliers
from balance_cli.calibration.term_choice import LINEAR_TERMS


def points_of(load, reading):
    m = len(load)
    return CalibrationPoints(
        ("a",), ("Fz",), ("s",), np.c_[reading], np.c_[load], np.zeros(m, int), np.ones(m), np.ones(1)
    )


def test_three_rows_on_a_line_do_not_make_outliers_of_the_two_others():
    """Whole counts of a display, with 0.7 % of scatter: without rows 3 and 4 the residual is 0.005 %."""
    load = np.array([0.0, 0.02, 0.25, 0.75, 1.0])
    screened = screen_outliers(points_of(load, 180.0 + np.round(750.0 * load) + [0.0, 0.0, 6.0, -8.0, 0.0]))
    assert screened.outliers == ()
    assert len(screened.screening_notes) == 1 and "row 3" in screened.screening_notes[0]
    assert np.sqrt(screened.fit.model.residual_covariance[0, 0]) == pytest.approx(5.9, rel=0.1)


@pytest.mark.parametrize("rows", [5, 6, 8, 12])
def test_rows_of_equal_noise_stay(rows):
    rng = np.random.default_rng(rows)
    tables = [
        points_of(np.linspace(0, 1, rows), np.linspace(0, 1, rows) + 1e-3 * rng.normal(size=rows)) for _ in range(60)
    ]
    assert sum(len(screen_outliers(table).outliers) for table in tables) == 0


def test_a_wrong_row_of_eight_is_still_found():
    load = np.linspace(0, 1, 8)
    reading = load + 1e-3 * np.random.default_rng(1).normal(size=8)
    reading[3] += 0.2
    assert [outlier.row for outlier in screen_outliers(points_of(load, reading)).outliers] == [4]


def noisy_series_points(seed, wrong=0.0):
    """Four loads on four channels, each a series; the first channel scatters ten times as much in the last series."""
    rng, level = np.random.default_rng(seed), np.linspace(0.0, 1.0, 10)
    loads = np.vstack([np.outer(level, np.eye(4)[j]) for j in range(4)])
    read = loads @ (np.eye(4) + 0.1) + 1e-3 * rng.normal(size=loads.shape)
    read[-10:, 0] += 1e-2 * rng.normal(size=10)
    read[34, 0] += wrong
    names, components = ("a", "b", "c", "d"), ("Fx", "Fz", "My", "Mz")
    return CalibrationPoints(names, components, ("s",), read, loads, np.zeros(40, int), np.ones(40), np.ones(4))


@pytest.mark.parametrize("seed", [4, 10, 32, 40, 46, 47])
def test_the_worst_row_of_a_series_that_scatters_as_a_whole_stays(seed):
    """Of 60 such tables 7 lost a good row, many times the scatter of the other series from its prediction."""
    assert screen_outliers(noisy_series_points(seed), LINEAR_TERMS).outliers == ()


def test_a_wrong_row_of_a_series_that_scatters_is_still_found():
    assert [each.row for each in screen_outliers(noisy_series_points(4, -0.4), LINEAR_TERMS).outliers] == [35]


def test_a_degree_of_freedom_remains_where_a_short_table_has_misfits():
    """Series of a tare point and one load each that disagree: without any dof the others agree by construction."""
    x = np.vstack([np.outer([0.0, side], np.eye(3)[j]) for j in range(3) for side in (1.0, -1.0)])
    counts = [[7954, 8085, 8009], [36812, 8626, 7928], [7843, 7890, 7899], [-21183, 7488, 7979]]
    counts += [[8049, 8002, 8137], [8739, 41099, 7685], [8014, 7994, 8071], [7334, -25086, 8608]]
    counts += [[8070, 8005, 8001], [7808, 7760, 33246], [8093, 7978, 8050], [8356, 8078, -17191]]
    series = np.repeat(np.arange(6), 2)
    points = CalibrationPoints(
        ("a", "b", "c"),
        ("Fx", "Fy", "Fz"),
        ("s",),
        np.array(counts, float),
        x,
        np.zeros(12, int),
        np.ones(12),
        np.ones(3),
        series=series,
    )
    whole = calibrate_all_trims(points)
    assert np.min(whole.model.dof) >= 1 and np.isfinite(whole.noise.reading_covariance).all()


def three_axes_points(seed, hysteresis, tilt, noise, wrong):
    """Six series of four rows, one of which reads wrong; also that row (1 is the first)."""
    level = np.array([0.0, 0.5, 1.0, 0.5])
    x = np.vstack([np.outer(side * level, np.eye(3)[j]) for j in range(3) for side in (1.0, -1.0)])
    rng, m = np.random.default_rng(seed), len(x)
    row = int(rng.choice(np.flatnonzero(np.any(x != 0, axis=1))))
    applied = np.einsum("mk,mkl->ml", x, (np.eye(3) + tilt * rng.normal(size=(6, 3, 3)))[np.repeat(np.arange(6), 4)])
    applied += hysteresis * np.sign(np.diff(x, axis=0, prepend=0.0))
    read = applied @ (np.eye(3) + 0.1) + noise * rng.normal(size=x.shape)
    read[row, 1] += wrong
    names, components = ("a", "b", "c"), ("Fx", "Fy", "Fz")
    return CalibrationPoints(names, components, ("s",), read, x, np.zeros(m, int), np.ones(m), np.ones(3)), row + 1


@pytest.mark.parametrize("seed", [1, 4, 5])
def test_a_wrong_row_of_four_is_judged_by_the_scatter_of_all_series(seed):
    """Its three neighbors tell their scatter with one degree of freedom: 11 of 30 such rows had stayed, now 2."""
    points, row = three_axes_points(seed, 2e-3, 0.0, 5e-4, 0.06)
    assert [each.row for each in screen_outliers(points).outliers] == [row]


@pytest.mark.parametrize("seed", [8, 20, 22])
def test_a_wrong_row_of_four_does_not_make_the_scale_by_which_it_is_judged(seed):
    """Where a channel hardly feels the load, 4 of 30 such rows had stayed, now none; 47 times the scatter."""
    points, row = three_axes_points(seed, 1e-3, 2e-3, 3e-4, 0.04)
    assert [each.row for each in screen_outliers(points).outliers] == [row]
