"""The regression of a calibration against brute force: every claim of `least_squares` computed the long way."""

from fractions import Fraction

import numpy as np
import pytest

from balance_cli.calibration.extended_precision import inner_products
from balance_cli.calibration.least_squares import CollinearError, solve_least_squares


def problem(seed=0, blocks=6, rows=9, p=4, c=2):
    """Columns, outputs, blocks in no order, and weights; no two numbers alike."""
    rng = np.random.default_rng(seed)
    block = rng.permutation(np.repeat(np.arange(blocks) * 3 + 2, rows))
    X = rng.normal(size=(len(block), p)) @ rng.normal(size=(p, p)) + rng.normal(size=(blocks * 3, p))[block]
    Y = X @ rng.normal(size=(p, c)) + 10.0 * rng.normal(size=(blocks * 3, c))[block] + rng.normal(size=(len(block), c))
    return X, Y, block, rng.uniform(0.3, 3.0, len(block))


def by_hand(X, Y, block, weight, drop=None):
    """Zeros and coefficients by lstsq on all rows but some."""
    kept = np.ones(len(X), bool) if drop is None else ~drop
    D = (block[:, None] == np.unique(block)).astype(float)
    A = np.hstack([D, X])
    root = np.sqrt(weight)[:, None]
    found = np.linalg.lstsq((root * A)[kept], (root * Y)[kept], rcond=None)[0]
    return found[: D.shape[1]], found[D.shape[1] :], A


@pytest.mark.parametrize("weighted", [False, True])
def test_coefficients_zeros_and_errors(weighted):
    X, Y, block, weight = problem()
    w = weight if weighted else np.ones(len(X))
    fit = solve_least_squares(X, Y, block, weight if weighted else None)
    zeros, b, A = by_hand(X, Y, block, w)
    np.testing.assert_allclose(fit.coefficients, b, rtol=1e-10)
    np.testing.assert_allclose(fit.zeros, zeros, rtol=1e-10)
    residuals = Y - A @ np.vstack([zeros, b])
    np.testing.assert_allclose(fit.residuals, residuals, atol=1e-11)
    assert fit.dof == len(X) - A.shape[1]
    variance = (w @ residuals**2) / fit.dof
    covariance = np.linalg.inv((A.T * w) @ A)
    np.testing.assert_allclose(fit.variance, variance, rtol=1e-10)
    first = len(zeros)
    np.testing.assert_allclose(fit.inverse, covariance[first:, first:], rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(fit.sigma, np.sqrt(np.diag(covariance)[first:, None] * variance), rtol=1e-9)
    np.testing.assert_allclose(fit.t, b / fit.sigma, rtol=1e-9)
    hat = np.einsum("ij,jk,ik->i", A, covariance, A) * w
    np.testing.assert_allclose(fit.leverage, hat, rtol=1e-9)
    np.testing.assert_allclose(fit.root.T @ fit.root @ fit.inverse, np.eye(X.shape[1]), atol=1e-9)


def test_press_is_the_error_of_a_row_that_took_no_part():
    X, Y, block, weight = problem()
    fit = solve_least_squares(X, Y, block, weight)
    for row in range(len(X)):
        drop = np.arange(len(X)) == row
        zeros, b, A = by_hand(X, Y, block, weight, drop)
        np.testing.assert_allclose(fit.press_residuals[row], Y[row] - A[row] @ np.vstack([zeros, b]), rtol=1e-8)
    np.testing.assert_allclose(fit.press, weight @ fit.press_residuals**2)


def test_left_out_is_the_error_of_blocks_that_only_give_their_own_zero():
    X, Y, block, weight = problem()
    fit = solve_least_squares(X, Y, block, weight)
    group = np.where(block < 8, 0, np.where(block < 15, 1, 2))
    errors = fit.cross_validation_errors(group)
    for name in np.unique(group):
        mine = group == name
        b = by_hand(X, Y, block, weight, mine)[1]
        left = Y - X @ b
        for one in np.unique(block[mine]):
            rows = block == one
            expected = left[rows] - np.average(left[rows], axis=0, weights=weight[rows])
            np.testing.assert_allclose(errors[rows], expected, atol=1e-9)


def test_a_block_without_which_a_term_is_unknown_has_no_error_left_out():
    X, Y, block, weight = problem()
    last = block == block.max()
    X[:, 0] = np.where(last, X[:, 0], 0.0)
    errors = solve_least_squares(X, Y, block, weight).cross_validation_errors(block)
    assert np.isnan(errors[last]).all() and np.isfinite(errors[~last]).all()


def test_variance_inflation_is_that_of_its_definition():
    """1 / (1 - R^2) of the regression of a term, zeros taken out, on all others."""
    X, Y, block, _ = problem(p=5)
    fit = solve_least_squares(X, Y, block)
    ones = np.ones(len(X))
    for j in range(X.shape[1]):
        others = np.delete(X, j, axis=1)
        zeros, b, A = by_hand(others, X[:, [j]], block, ones)
        left = X[:, j] - (A @ np.vstack([zeros, b]))[:, 0]
        within = X[:, j] - np.array([X[block == one, j].mean() for one in block])
        np.testing.assert_allclose(fit.variance_inflation[j], (within @ within) / (left @ left), rtol=1e-9)
    assert np.all(fit.variance_inflation > 1.0)


def test_a_weight_of_two_is_a_row_read_twice():
    X, Y, block, _ = problem()
    weight = np.where(np.arange(len(X)) % 3 == 0, 2.0, 1.0)
    twice = np.r_[np.arange(len(X)), np.flatnonzero(weight == 2.0)]
    one, other = solve_least_squares(X, Y, block, weight), solve_least_squares(X[twice], Y[twice], block[twice])
    np.testing.assert_allclose(one.coefficients, other.coefficients, rtol=1e-10)
    np.testing.assert_allclose(one.inverse, other.inverse, rtol=1e-9, atol=1e-14)
    assert other.dof - one.dof == int((weight == 2.0).sum())


def test_units_make_no_difference():
    X, Y, block, weight = problem()
    units = np.array([1e-9, 1.0, 3e7, 1e3])
    one, other = solve_least_squares(X, Y, block, weight), solve_least_squares(X * units, Y, block, weight)
    np.testing.assert_allclose(other.coefficients * units[:, None], one.coefficients, rtol=1e-12)
    np.testing.assert_allclose(other.variance_inflation, one.variance_inflation, rtol=1e-11)
    np.testing.assert_allclose(other.press_residuals, one.press_residuals, rtol=1e-9)


def test_ill_conditioned_terms_keep_their_digits():
    """Columns alike to 1e-7 whose coefficients are known: double precision alone would leave two digits or so."""
    rng = np.random.default_rng(4)
    block = np.repeat(np.arange(4), 50)
    a = rng.integers(-1000, 1000, 200) / 1024.0
    b = a + rng.integers(-1000, 1000, 200) / 2.0**33
    X = np.column_stack([a, b])
    Y = (X @ np.array([3.0, -2.0]) + block)[:, None]
    fit = solve_least_squares(X, Y, block)
    np.testing.assert_allclose(fit.coefficients[:, 0], [3.0, -2.0], rtol=1e-9)
    # Gram determinants in integers give the exact inverse.
    A, B = np.round(a * 2**33).astype(object), np.round(b * 2**33).astype(object)
    A, B = A.astype(int).astype(object), B.astype(int).astype(object)
    A = [50 * int(v) - int(sum(A[block == k])) for v, k in zip(A, block, strict=True)]
    B = [50 * int(v) - int(sum(B[block == k])) for v, k in zip(B, block, strict=True)]
    aa, ab, bb = (sum(p * q for p, q in zip(s, t, strict=True)) for s, t in ((A, A), (A, B), (B, B)))
    exact = (50 * 2**33) ** 2 * bb / (aa * bb - ab * ab)
    np.testing.assert_allclose(fit.inverse[0, 0], exact, rtol=1e-11)


def test_terms_that_say_the_same_are_refused_by_name():
    X, Y, block, _ = problem()
    with pytest.raises(CollinearError) as caught:
        solve_least_squares(np.column_stack([X, X[:, 0] - 2.0 * X[:, 2]]), Y, block)
    share = caught.value.share
    assert share[[0, 2, 4]].min() > 0.1 and share[[1, 3]].max() < 1e-6


def test_a_term_that_the_zeros_explain_is_refused():
    X, Y, block, _ = problem()
    X[:, 1] = block
    with pytest.raises(CollinearError) as caught:
        solve_least_squares(X, Y, block)
    np.testing.assert_array_equal(caught.value.share, [0.0, 1.0, 0.0, 0.0])


def test_terms_in_extended_precision_are_refused_all_the_same():
    X, Y, block, _ = problem()
    with pytest.raises(CollinearError):
        solve_least_squares(np.column_stack([X, X[:, 0]]).astype(np.longdouble), Y, block)


def test_zeros_far_above_what_a_term_does_within_a_sequence():
    """A million times as far, with weights that are no powers of two: nothing of the term may be lost."""
    rng = np.random.default_rng(8)
    block = np.repeat(np.arange(5), 40)
    small = rng.integers(-1000, 1000, (200, 3)) / 1024.0
    X = small + 2.0**20 * (1 + block)[:, None]
    Y, weight = small @ rng.integers(-5, 5, (3, 2)) + block[:, None], rng.uniform(0.5, 2.0, 200)
    one, other = solve_least_squares(X, Y, block, weight), solve_least_squares(small, Y, block, weight)
    np.testing.assert_allclose(one.coefficients, other.coefficients, atol=1e-12)
    np.testing.assert_allclose(one.inverse, other.inverse, rtol=1e-12, atol=1e-17)


def test_inner_products_keep_what_rounding_takes():
    """Sums that cancel to a part in 1e25 of their size, against exact arithmetic."""
    rng = np.random.default_rng(9)
    A, r = rng.normal(size=(41, 3)).astype(np.longdouble), rng.normal(size=(41, 2)).astype(np.longdouble)
    A[0], r[0] = 1.0, 0.0
    r[0] = -inner_products(A[1:, :1], r[1:])[0]
    found = inner_products(A, r)
    rows = range(len(A))
    for j, k in ((0, 0), (0, 1), (1, 0), (2, 1)):
        exact = sum(exactly(A[i, j]) * exactly(r[i, k]) for i in rows)
        size = sum(abs(exactly(A[i, j]) * exactly(r[i, k])) for i in rows)
        assert abs(exactly(found[j, k]) - exact) <= Fraction(2) ** -60 * abs(exact) + Fraction(2) ** -110 * size


def exactly(value):
    high = float(value)
    return Fraction(high) + Fraction(float(value - np.longdouble(high)))
