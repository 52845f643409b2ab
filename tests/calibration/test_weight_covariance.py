"""Weights of redundant channels from few rows: near the best ones, with intervals that hold what they state."""

import numpy as np
import pytest

from balance_cli.calibration.math_model import weighted_inverse
from balance_cli.calibration.weight_covariance import (
    correlation_shrinkage,
    moderated_variances,
    weight_covariance,
    weight_widening,
)
from balance_cli.signals import distributions as stats

LOADS, CHANNELS, DRAWS = 2, 6, 300
RNG = np.random.default_rng(31)
COMMON = RNG.standard_normal((CHANNELS, 1))
INDEPENDENT, CORRELATED = np.eye(CHANNELS), 0.3 * np.eye(CHANNELS) + COMMON @ COMMON.T


def variances(true: np.ndarray, dof: int) -> np.ndarray:
    """For each draw: variance of the first load over the least possible, and share of errors within 95 % intervals."""
    root, rows = np.linalg.cholesky(true), []
    for _ in range(DRAWS):
        residuals = root @ RNG.standard_normal((CHANNELS, dof))
        S, C = residuals @ residuals.T / dof, RNG.standard_normal((CHANNELS, LOADS))
        W, best = (weighted_inverse(C, each) for each in (weight_covariance(S, dof), true))
        variance, stated = (float((W @ each @ W.T)[0, 0]) for each in (true, S))
        reach = stats.t.ppf(0.975, dof) * np.sqrt(stated * weight_widening(S, dof, CHANNELS - LOADS) / variance)
        rows.append((variance / float((best @ true @ best.T)[0, 0]), 1.0 - 2.0 * float(stats.norm.sf(reach))))
    return np.array(rows)


@pytest.mark.parametrize(("true", "dof"), [(INDEPENDENT, 4), (INDEPENDENT, 9), (CORRELATED, 9), (CORRELATED, 100)])
def test_weights_from_few_rows_are_near_the_best(true, dof):
    excess, coverage = variances(true, dof).T
    # Weights by the covariance itself have 2 times the least variance with 9 degrees of freedom; none exist with 4.
    assert np.median(excess) < (1.05 if dof == 100 else 1.6)
    assert 0.93 < coverage.mean() < 0.97


def test_correlations_that_chance_does_not_explain_are_kept():
    assert correlation_shrinkage(CORRELATED, 1000.0) < 0.01
    assert correlation_shrinkage(INDEPENDENT, 1e300) == 1.0
    assert correlation_shrinkage(COMMON @ COMMON.T, 1.0) == 1.0
    assert weight_covariance(CORRELATED, float("nan")) == pytest.approx(CORRELATED)


@pytest.mark.parametrize(("dof", "most"), [(2, 1.25), (4, 1.12), (9, 1.06)])
def test_loads_by_channels_of_like_noise_and_few_rows_are_as_good_as_by_equal_weights(dof, most):
    rng = np.random.default_rng(11)
    ratios = []
    for _ in range(150):
        C, noise = rng.standard_normal((8, 3)), rng.standard_normal((8, dof))
        weighted = np.linalg.solve(weight_covariance(noise @ noise.T / dof, dof), C)
        W = np.linalg.solve(C.T @ weighted, weighted.T)
        ratios.append(np.sum(W**2) / np.trace(np.linalg.inv(C.T @ C)))
    assert np.sqrt(np.mean(ratios)) < most


def test_variances_of_unlike_channels_or_many_rows_remain():
    unlike = np.array([1e-12, 1e-6, 1.0, 1e6, 1e12])
    assert moderated_variances(unlike, 4.0) is unlike
    like = np.array([1.0, 1.1, 0.9, 1.05])
    assert moderated_variances(like, 200.0) is like
    # An inverse gamma prior: the posterior mean of the precision is that of d + n degrees of freedom.
    rng = np.random.default_rng(12)
    true = 8.0 * 2.5 / rng.chisquare(8.0, 20000)
    estimates = true * rng.chisquare(3.0, 20000) / 3.0
    assert moderated_variances(estimates, 3.0) == pytest.approx((8.0 * 2.5 + 3.0 * estimates) / 11.0, rel=0.06)
