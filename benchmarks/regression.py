"""The regression of a calibration with all its tests against the same numbers from statsmodels, as its users get them.

96 terms, 8 channels, 2000 points in 40 load series, each with its own zero. Both give, for every channel,
coefficients, standard errors and the error of every row predicted by all others, and the variance inflation of every
term. The other one fits OLS channel by channel, takes `get_influence().resid_press` of each, and calls
`variance_inflation_factor` term by term, which regresses each term on all others: there is no call that serves all
terms at once. The columns it gets for that have their means in each sequence taken out, which is the quicker way and
gives the same number.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.least_squares import solve_least_squares
from balance_cli.calibration.terms import all_terms, term_values
from benchmarks.comparison import Comparison, program_with_version

Array = NDArray[np.float64]
Index = NDArray[np.intp]

POINTS, SEQUENCES, CHANNELS, LOADS = 2000, 40, 8, 6
NOISE = 1e-3
REPETITIONS = 7


@dataclass(frozen=True)
class RegressionResult:
    """Coefficients and standard errors (p, c), errors of rows left out (m, c), variance inflation (p,)."""

    coefficients: Array
    sigma: Array
    press: Array
    inflation: Array


def compare() -> list[Comparison]:
    """Time both."""
    X, Y, block = problem()
    ours, fast = _time_call(lambda: _with_balance_cli(X, Y, block), REPETITIONS)
    theirs, slow = _time_call(lambda: _with_statsmodels(X, Y, block), 1)
    apart = max(
        _relative_difference(getattr(fast, name), getattr(slow, name)) for name in RegressionResult.__annotations__
    )
    size = f"{POINTS} points, {X.shape[1]} terms, {CHANNELS} channels"
    note = f"{size}; coefficients, sigma, rows left out, inflation; they differ by {apart:.0e}"
    program = program_with_version("statsmodels", "OLS")
    return [Comparison("`calibrate`, regression", "fit", ours, program, theirs, note)]


def problem(seed: int = 0) -> tuple[Array, Array, Index]:
    """Columns of all terms (m, p), readings (m, c) and sequences (m,) of random loads."""
    rng = np.random.default_rng(seed)
    terms = all_terms(LOADS)
    X = term_values(terms, rng.uniform(-1.0, 1.0, (POINTS, LOADS)))
    block = np.repeat(np.arange(SEQUENCES), POINTS // SEQUENCES)
    Y = X @ rng.standard_normal((len(terms), CHANNELS)) + rng.standard_normal((SEQUENCES, CHANNELS))[block]
    return X, Y + NOISE * rng.standard_normal(Y.shape), block


def _time_call(call: Callable[[], RegressionResult], times: int) -> tuple[float, RegressionResult]:
    """The shortest of so many calls, in seconds of this process, and what it gave."""
    found, shortest = call(), np.inf
    for _ in range(times):
        start = time.process_time()
        found = call()
        shortest = min(shortest, time.process_time() - start)
    return float(shortest), found


def _relative_difference(one: Array, other: Array) -> float:
    return float(np.max(np.abs(one - other)) / np.max(np.abs(other)))


def _with_balance_cli(X: Array, Y: Array, block: Index) -> RegressionResult:
    fit = solve_least_squares(X, Y, block)
    return RegressionResult(fit.coefficients, fit.sigma, fit.press_residuals, fit.variance_inflation)


def _with_statsmodels(X: Array, Y: Array, block: Index) -> RegressionResult:
    from statsmodels.regression.linear_model import OLS
    from statsmodels.stats.outliers_influence import variance_inflation_factor

    zeros = (block[:, None] == np.unique(block)).astype(float)
    whole, first = np.hstack([zeros, X]), zeros.shape[1]
    fits = [OLS(y, whole).fit() for y in Y.T]
    centred = X - np.stack([X[block == name].mean(axis=0) for name in np.unique(block)])[block]
    return RegressionResult(
        np.column_stack([fit.params[first:] for fit in fits]),
        np.column_stack([fit.bse[first:] for fit in fits]),
        np.column_stack([fit.get_influence().resid_press for fit in fits]),
        np.array([variance_inflation_factor(centred, term) for term in range(X.shape[1])]),
    )
