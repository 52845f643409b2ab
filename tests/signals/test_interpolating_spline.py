"""Interpolating splines against scipy, which builds them with other code."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline, make_interp_spline

from balance_cli.signals.interpolating_spline import interpolating_spline, spline_through


@pytest.mark.parametrize("count", [2, 3, 4, 5, 6, 7, 8, 300])
@pytest.mark.parametrize("degree", [3, 5])
def test_spline_and_its_derivatives_through_uneven_points(count, degree):
    rng = np.random.default_rng(count)
    x = np.cumsum(rng.uniform(0.5, 1.5, count))
    y = np.sin(x) + 1e-3 * rng.standard_normal(count)
    expected = make_interp_spline(x, y, k=min(degree, count - 1))
    # Within, at the points, and somewhat outside, where the outer polynomials continue.
    at = np.r_[np.linspace(x[0] - 0.05, x[-1] + 0.05, 997), x]
    spline = interpolating_spline(x, y, degree)
    for order in range(3):
        np.testing.assert_allclose(spline(at), expected(at, order), rtol=0, atol=1e-10)
        spline = spline.derivative()
    np.testing.assert_allclose(interpolating_spline(x, y, degree)(x), y, rtol=0, atol=1e-13)


def test_complex_values_of_any_shape():
    rng = np.random.default_rng(2)
    x = np.cumsum(rng.uniform(0.5, 1.5, 40))
    y = rng.standard_normal((40, 2, 3)) + 1j * rng.standard_normal((40, 2, 3))
    at = rng.uniform(x[0], x[-1], (5, 7))
    np.testing.assert_allclose(interpolating_spline(x, y, 3)(at), CubicSpline(x, y)(at), rtol=0, atol=1e-12)


def test_derivative_of_a_constant_is_zero():
    line = interpolating_spline([0.0, 2.0], [1.0, 5.0], 5)
    assert line(np.array([0.5, 3.0])) == pytest.approx([2.0, 7.0])
    slope = line.derivative()
    assert slope(1.0) == pytest.approx(2.0)
    assert np.all(slope.derivative()(np.array([0.0, 1.0])) == 0.0)


@pytest.mark.parametrize("count", [2, 5, 2000])
@pytest.mark.parametrize(
    "ends", [(-1.0, -0.5), (0.3, 0.3), (7.0, 21.0), (-1.0, 90.0), (400.0, 1100.0), (500.0, 1900.0), (2500.0, 2600.0)]
)
def test_a_part_has_the_polynomials_of_the_whole(count, ends):
    rng = np.random.default_rng(3)
    x = np.cumsum(rng.uniform(0.5, 1.5, count))
    spline = spline_through(x, rng.standard_normal((count, 2)) + 0j, 3)
    at = np.linspace(*ends, 50)
    np.testing.assert_array_equal(spline.between(*ends)(at), spline.polynomials()(at))
