"""The regression against the certified values of NIST's reference data, and against exact arithmetic."""

from fractions import Fraction

import numpy as np
import pytest

from balance_cli.calibration.least_squares import solve_least_squares
from tests.support.certified_data import DATASETS

# Correct digits of (coefficients, standard errors, residual standard deviation) that must be reached; certified values
# have 15, and doubles hold 15.9. Where the certified value is zero: minus the logarithm of what comes out.
DIGITS = {
    "Longley": (14.0, 14.0, 15.0),
    "Filip": (10.5, 10.0, 11.5),
    "Wampler1": (13.0, 13.0, 13.0),
    "Wampler2": (15.0, 15.0, 15.0),
    "Wampler3": (13.0, 11.5, 14.5),
    "Wampler4": (13.0, 11.5, 14.5),
    "Wampler5": (13.0, 11.5, 14.5),
}


def extended(value):
    """An exact number to the nearest in extended precision: its leading part, then what that leaves."""
    found, left = np.longdouble(0), Fraction(value)
    for _ in range(3):
        part = float(left)
        found += np.longdouble(part)
        left -= Fraction(part)
    return found


def fitted(data):
    X = np.array([[extended(value) for value in row] for row in data.X], np.longdouble)
    y = np.array([[extended(value)] for value in data.y], np.longdouble)
    return solve_least_squares(X, y, np.zeros(len(y), int))


def solved_exactly(data):
    """Coefficients, intercept first, and the diagonal of (X'X)^-1, by elimination of the normal equations."""
    rows = [(Fraction(1), *row) for row in data.X]
    p = len(rows[0])
    N = [
        [sum(row[i] * row[j] for row in rows) for j in range(p)]
        + [sum(row[i] * y for row, y in zip(rows, data.y, strict=True))]
        + [Fraction(int(i == j)) for j in range(p)]
        for i in range(p)
    ]
    for i in range(p):
        N[i] = [value / N[i][i] for value in N[i]]
        for other in range(p):
            if other != i:
                N[other] = [a - N[other][i] * b for a, b in zip(N[other], N[i], strict=True)]
    return [row[p] for row in N], [row[p + 1 + i] for i, row in enumerate(N)]


def digits(found, certified):
    """The fewest correct digits among numbers: their log relative error, absolute where the certified value is zero."""
    worst = 17.0
    for one, known in zip(np.atleast_1d(found), certified, strict=True):
        exact = Fraction(known)
        error = abs(Fraction(float(one)) - exact) / (abs(exact) if exact else 1)
        worst = min(worst, -float(np.log10(float(error)))) if error else worst
    return worst


def intercept_sigma(fit, data):
    """Standard error of the zero, from the covariance of the terms."""
    means = np.array([float(sum(column) / len(column)) for column in zip(*data.X, strict=True)])
    return np.sqrt(fit.variance[0] * (1 / len(data.y) + means @ fit.inverse @ means))


def reached(name):
    data = DATASETS[name]
    fit = fitted(data)
    b = np.r_[fit.zeros[:, 0], fit.coefficients[:, 0]]
    sigma = np.r_[intercept_sigma(fit, data), fit.sigma[:, 0]]
    return (
        digits(b, data.coefficients),
        digits(sigma, data.sigma),
        digits(np.sqrt(fit.variance), [data.residual]),
    )


@pytest.mark.parametrize("name", DATASETS)
def test_certified_digits(name):
    assert all(got >= least for got, least in zip(reached(name), DIGITS[name], strict=True)), reached(name)


@pytest.mark.parametrize("name", DATASETS)
def test_certified_values_are_those_of_exact_arithmetic(name):
    data = DATASETS[name]
    b, inverse = solved_exactly(data)
    fitted_y = [b[0] + sum(c * value for c, value in zip(b[1:], row, strict=True)) for row in data.X]
    squares = sum((y - one) ** 2 for y, one in zip(data.y, fitted_y, strict=True))
    variance = squares / (len(data.y) - len(b))
    for got, certified in zip(b, data.coefficients, strict=True):
        assert got == pytest.approx(Fraction(certified), rel=1e-14, abs=0)
    for got, certified in zip(inverse, data.sigma, strict=True):
        assert float(got * variance) ** 0.5 == pytest.approx(float(certified), rel=1e-14, abs=0)
    assert float(variance) ** 0.5 == pytest.approx(float(data.residual), rel=1e-14, abs=0)


@pytest.mark.parametrize("name", DATASETS)
def test_regression_is_that_of_exact_arithmetic(name):
    """Coefficients as doubles hold them: the certified ones are rounded to 15 digits."""
    b, inverse = solved_exactly(DATASETS[name])
    fit = fitted(DATASETS[name])
    assert digits(np.r_[fit.zeros[:, 0], fit.coefficients[:, 0]], b) >= DIGITS[name][0]
    assert digits(np.diag(fit.inverse), inverse[1:]) >= (10.5 if name == "Filip" else 15.0)
