"""Random terms: variances by restricted likelihood, directions that were left out, and the choice of the model."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.calibration.block_zeros import subtract_block_means
from balance_cli.calibration.fit import CalibrationPoints, fit_calibration_model
from balance_cli.calibration.penalized_regression import solve_penalized
from balance_cli.calibration.random_terms import _independent_share, fit_random_terms
from balance_cli.calibration.variance_components import estimate_variance_components

COMPONENTS = ("Fx", "Fy", "Fz")
STEPS = np.array([0.0, 0.25, 0.5, 0.75, 1.0, 0.75, 0.5, 0.25])
NOISE = 2e-4


def ramps(repeats=1):
    """Each load up and down in both directions, one series for each: loads (m, 3), series (m,)."""
    parts = [np.outer(side * STEPS, np.eye(3)[j]) for _ in range(repeats) for j in range(3) for side in (1, -1)]
    return np.vstack(parts), np.repeat(np.arange(len(parts)), len(STEPS))


def points_of(x, series, readings):
    return CalibrationPoints(
        tuple(f"g{c}" for c in range(readings.shape[1])),
        COMPONENTS,
        ("stand",),
        readings,
        x,
        np.zeros(len(x), np.intp),
        np.ones(len(x)),
        np.abs(x).max(axis=0),
        series=series,
    )


def softening(rng):
    """A balance with a small F|F| of every load in every channel: coefficients (6, 4) of F and F|F|."""
    linear = rng.standard_normal((3, 4)) + 2.0 * np.eye(3, 4)
    return np.vstack([linear, 3e-3 * rng.standard_normal((3, 4))])


def readings_of(coefficients, x, series, rng):
    shift = 5e-3 * rng.standard_normal((series.max() + 1, coefficients.shape[1]))[series]
    exact = np.hstack([x, x * np.abs(x)]) @ coefficients
    return exact + shift + NOISE * rng.standard_normal(exact.shape)


def dense_restricted_likelihood(F, Z, t, s, y):
    """Log likelihood of the part of y (m,) that F does not explain, from the covariance matrix itself."""
    basis = np.linalg.svd(F)[0][:, F.shape[1] :]
    V = basis.T @ (s**2 * np.eye(len(y)) + (Z * t**2) @ Z.T) @ basis
    left = basis.T @ y
    return -0.5 * (np.linalg.slogdet(V)[1] + left @ np.linalg.solve(V, left))


def test_variances_maximize_the_restricted_likelihood():
    rng = np.random.default_rng(5)
    F, Z, family = rng.standard_normal((60, 3)), rng.standard_normal((60, 14)), np.repeat([0, 1], [6, 8])
    scale = np.array([1.0, 3.0])
    u = rng.standard_normal((14, 2)) * np.array([0.3, 0.02])[family][:, None] * scale
    y = F @ rng.standard_normal((3, 2)) + Z @ u + 0.1 * scale * rng.standard_normal((60, 2))
    found = estimate_variance_components(F, Z, family, y, scale, 60)

    def likelihood(size, noise):
        parts = (dense_restricted_likelihood(F, Z, size[family] * scale[c], noise[c], y[:, c]) for c in range(2))
        return sum(parts)

    best = likelihood(found.size, found.noise)
    assert found.log_likelihood == pytest.approx(best, rel=1e-9)
    for place in range(2):
        for factor in (0.9, 1.1):
            size, noise = found.size.copy(), found.noise.copy()
            size[place] *= factor
            assert likelihood(size, found.noise) < best
            noise[place] *= factor
            assert likelihood(found.size, noise) < best


def test_penalized_regression_predicts_rows_and_blocks_that_are_left_out_as_a_fit_without_them():
    rng = np.random.default_rng(6)
    X, block = rng.standard_normal((40, 7)), np.repeat(np.arange(8), 5)
    y, weight = rng.standard_normal(40), rng.uniform(0.5, 2.0, 40)
    penalty = np.r_[0.0, 0.0, rng.uniform(0.5, 3.0, 5)]
    fit = solve_penalized(X, y, block, weight, penalty)
    rest = block != 3
    other = solve_penalized(X[rest], y[rest], block[rest], weight[rest], penalty)
    left = y[~rest] - X[~rest] @ other.coefficients[:, 0]
    own_zero = np.average(left, weights=weight[~rest])
    assert fit.cross_validation_errors(block)[~rest, 0] == pytest.approx(left - own_zero, rel=1e-9)
    alone = np.arange(40) != 17
    other = solve_penalized(X[alone], y[alone], block[alone], weight[alone], penalty)
    error = y[17] - X[17] @ other.coefficients[:, 0] - other.zeros[3, 0]
    assert fit.press_residuals[17, 0] == pytest.approx(error, rel=1e-9)
    rows = np.vstack([subtract_block_means(X, block, weight), np.diag(penalty)])
    expected = np.linalg.lstsq(rows, np.r_[subtract_block_means(y[:, None], block, weight)[:, 0], np.zeros(7)])[0]
    assert fit.coefficients[:, 0] == pytest.approx(expected, rel=1e-9)


def test_a_direction_that_was_left_out_is_extrapolated_no_worse_than_by_plain_least_squares():
    ratios, inside = [], []
    for seed in range(6):
        rng = np.random.default_rng([seed, 7])
        x, series = ramps()
        readings = readings_of(softening(rng), x, series, rng)
        for left_out in range(6):
            rest, test = series != left_out, (series == left_out) & x.any(axis=1)
            number = np.unique(series[rest], return_inverse=True)[1]
            change = readings[test] - readings[series == left_out][0]
            points = points_of(x[rest], number, readings[rest])
            selected = fit_calibration_model(points)
            model = (fit_random_terms(points, selected) or selected).model
            computed = model.loads(change)[0]
            interval = model.interval(computed, 2.0 * model.residual_covariance)
            inside.append(np.abs(computed - x[test]) <= interval)
            errors = [plain_error(degree, x[rest], number, readings[rest], change, x[test]) for degree in (1, 2)]
            ratios.append(np.mean((computed - x[test]) ** 2) / min(errors))
    assert np.sqrt(np.median(ratios)) < 0.9
    assert np.sqrt(np.quantile(ratios, 0.9)) < 1.3
    assert 0.88 < np.mean(inside) < 0.99


def plain_error(degree, x, series, readings, change, applied):
    """Mean squared error of least squares of the loads, or of loads and their squares, with a zero for each series."""
    X = np.hstack([x**power for power in range(1, degree + 1)])
    b = np.linalg.lstsq(subtract_block_means(X, series), subtract_block_means(readings, series))[0]
    inverse, found = np.linalg.pinv(b[:3].T), np.zeros_like(applied)
    for _ in range(30):
        curved = np.hstack([found**power for power in range(2, degree + 1)]) @ b[3:] if degree > 1 else 0.0
        found = (change - curved) @ inverse.T
    return np.mean((found - applied) ** 2)


def test_few_large_terms_are_selected_and_compute_the_loads():
    rng = np.random.default_rng(8)
    x, series = ramps(repeats=4)
    coefficients = np.vstack([rng.standard_normal((3, 4)) + 2.0 * np.eye(3, 4), np.zeros((3, 4))])
    coefficients[4, 1] = 0.05
    points = points_of(x, series, readings_of(coefficients, x, series, rng))
    fit = fit_calibration_model(points)
    assert fit_random_terms(points, fit) is None
    assert set(fit.model.channel_coefficients("g1")) == {*COMPONENTS, "Fy|Fy|"}


def test_slopes_that_scatter_between_series_are_an_error_of_new_loads():
    rng = np.random.default_rng(9)
    x, series = ramps(repeats=3)
    linear = rng.standard_normal((3, 4)) + 2.0 * np.eye(3, 4)
    scatter = 3e-3
    slopes = linear * (1.0 + scatter * rng.standard_normal((series.max() + 1, 3, 4)))
    readings = np.einsum("mk,mkc->mc", x, slopes[series]) + 1e-5 * rng.standard_normal((len(x), 4))
    points = points_of(x, series, readings)
    random = fit_random_terms(points, fit_calibration_model(points))
    assert random is not None
    # Of a gain of its own every new series has that error, whatever the number of rows that were fitted.
    at = np.eye(3)
    sigma = np.sqrt(np.diagonal(random.model.model_covariance(at), axis1=1, axis2=2))
    expected = scatter * np.sqrt(np.mean(linear**2, axis=0))
    assert np.all(sigma > 0.6 * expected) and np.all(sigma < 2.0 * expected)
    assert np.isnan(random.model.t[3:]).all() and np.isfinite(random.model.t[:3]).all()


def test_rows_that_were_excluded_leave_the_load_series_as_they_were():
    """The schedule of the other rows alone would read differently, with more load series or fewer."""
    rng = np.random.default_rng(4)
    x, series = ramps()
    points = replace(points_of(x, series, readings_of(softening(rng), x, series, rng)), series=None)
    rows = np.zeros(len(x), bool)
    rows[[3, 8, 21, 32]] = True
    fit = fit_calibration_model(points.exclude_rows(rows))
    found = fit_random_terms(points, fit)
    assert found is not None
    assert found.model.zeros.shape == fit.model.zeros.shape


def test_a_difference_between_the_directions_is_a_term_where_one_series_tells_each():
    """|F| or a gain of either series: the readings do not tell, and sigma contains both.

    As |F| the loads of both directions are right; the mean slope is wrong by 0.4 %.
    """
    rng = np.random.default_rng(3)
    x, series = ramps()
    linear, bilinear = rng.standard_normal((3, 4)) + 2.0 * np.eye(3, 4), 8e-3 * rng.standard_normal((3, 4))
    readings = x @ linear + np.abs(x) @ bilinear + 5e-3 * rng.standard_normal((6, 4))[series]
    points = points_of(x, series, readings + 1e-4 * rng.standard_normal(readings.shape))
    fit = fit_random_terms(points, fit_calibration_model(points))
    assert fit is not None
    check = np.vstack([0.5 * np.eye(3), -0.5 * np.eye(3)])
    errors = fit.model.loads(check @ linear + np.abs(check) @ bilinear)[0] - check
    straight = (check @ linear + np.abs(check) @ bilinear) @ np.linalg.pinv(linear) - check
    assert np.sqrt(np.mean(errors**2)) < 0.3 * np.sqrt(np.mean(straight**2))
    sigma = np.sqrt(np.diagonal(fit.model.load_covariance(check), axis1=1, axis2=2))
    assert np.all(np.abs(errors) < 2.0 * sigma)
    # With two series of each direction that agree it is no gain, and sigma is smaller.
    x, series = ramps(2)
    readings = x @ linear + np.abs(x) @ bilinear + 5e-3 * rng.standard_normal((12, 4))[series]
    points = points_of(x, series, readings + 1e-4 * rng.standard_normal(readings.shape))
    again = fit_random_terms(points, fit_calibration_model(points))
    known = np.sqrt(np.diagonal(again.model.load_covariance(check), axis1=1, axis2=2))
    assert np.all(known < 0.5 * sigma)


def test_the_error_of_a_load_is_no_evidence_of_each_channel_anew():
    rng = np.random.default_rng(4)
    x, own = rng.normal(size=(400, 3)), rng.normal(size=(400, 4))
    assert _independent_share(x, own, 400) == pytest.approx(1.0, abs=0.02)
    common = np.outer(rng.normal(size=400), [1.0, -2.0, 0.5, 3.0])
    assert _independent_share(x, common, 400) == pytest.approx(0.25, abs=2e-3)
    assert 0.3 < _independent_share(x, common + own, 400) < 0.7
