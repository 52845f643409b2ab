"""Temperature as an independent variable: apparent strain (zero shift) and drift of the sensitivity.

At the temperature T each channel reads, beside its model at the reference temperature T0,

    (T - T0) (a + D x),        a: zero shift per kelvin,    D: change of the sensitivities per kelvin,

with the loads x. The terms are tested for each channel at the level 0.01 for one spurious term anywhere in the balance,
beside the terms of the calibration model and with a zero for each load series. A zero shift also shows in the zeros of
the load series, where these follow the temperature of the series.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.block_zeros import subtract_block_means
from balance_cli.calibration.least_squares import (
    CollinearError,
    LeastSquares,
    solve_least_squares,
)
from balance_cli.calibration.temperature_terms import TemperatureTerms
from balance_cli.calibration.term_choice import TERM_SIGNIFICANCE_LEVEL
from balance_cli.signals import distributions as stats

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MIN_DOF = 5
"""Degrees of freedom below which no term is added, as in the search for other terms."""
MIN_ZEROS = 4
"""Load series from which their zeros show a dependence: two degrees of freedom beside the line."""
MIN_INDEPENDENT_SHARE = 1e-3
"""Share of a term that zeros and other terms must not explain, as for other terms."""
USUAL_DRIFT = 2e-4
"""Change of a sensitivity per kelvin that nobody has seen: of gauges that are matched to the material of the balance it
is 1e-4 to 5e-4."""
TUKEY = 4.685
"""Tuning constant of the biweight: 95 % efficient for normal errors."""
ROBUST_ITERATIONS = 5
"""Weights of the biweight settle to a few per cent."""
MIN_WEIGHT = 1e-3
"""Floor of the biweight, so that each load series keeps a zero."""


@dataclass(frozen=True)
class TemperatureRows:
    """Rows of a calibration: `channels` (m, c) [V], `loads` (m, k) [N, N m], `temperature` (m,) [degC].

    `columns`: for each channel the other terms (m, p) of its model, the loads among them. `load_series` (m,): number
    of the load series, each with its own zero; `weight` (m,).
    """

    channel_names: tuple[str, ...]
    components: tuple[str, ...]
    channels: Array
    loads: Array
    temperature: Array
    columns: Sequence[Array]
    load_series: Index
    weight: Array


def estimate_temperature_terms(rows: TemperatureRows, robust: bool = False) -> TemperatureTerms:
    """Select and fit the terms of temperature of each channel; `robust`: outliers are among the rows."""
    c, k = rows.channels.shape[1], rows.loads.shape[1]
    reference = float(np.average(rows.temperature, weights=rows.weight))
    theta = rows.temperature - reference
    candidates = theta[:, None] * np.column_stack([np.ones(len(theta)), rows.loads])
    level = TERM_SIGNIFICANCE_LEVEL / (c * (1 + k))
    coefficients, t = np.zeros((1 + k, c)), np.full((1 + k, c), np.nan)
    covariance = np.zeros((c, 1 + k, 1 + k))
    weights = [_biweight(rows, candidates, channel) if robust else rows.weight for channel in range(c)]
    problems = [
        _Problem(rows.columns[i], candidates, rows.channels[:, i], rows.load_series, weights[i], theta)
        for i in range(c)
    ]
    for channel, problem in enumerate(problems):
        estimate = _fit_channel(problem, level)
        coefficients[:, channel], covariance[channel] = estimate
        with np.errstate(divide="ignore", invalid="ignore"):
            t[:, channel] = estimate[0] / np.sqrt(np.diag(estimate[1]))
    if np.any(coefficients):
        # A balance that depends on temperature does so in all channels: no drift that is not seen is known to be zero.
        for channel in np.flatnonzero(~np.any(coefficients[1:], axis=0)).tolist():
            covariance[channel, 1:, 1:] = np.diag(_unseen_drift(problems[channel], rows.loads))
    return TemperatureTerms(
        rows.channel_names,
        rows.components,
        coefficients,
        covariance,
        t,
        reference,
        float(rows.temperature.min()),
        float(rows.temperature.max()),
        _temperature_under_load(rows),
    )


def _temperature_under_load(rows: TemperatureRows) -> Array:
    """Mean temperature (k,) [degC] of the rows, weighted by the square of each load."""
    squares = rows.loads**2 * rows.weight[:, None]
    return np.asarray(rows.temperature @ squares / np.maximum(squares.sum(axis=0), np.finfo(float).tiny))


@dataclass(frozen=True)
class _Problem:
    """One channel y (m,) with the columns (m, p) that it has in any case and the candidates (m, q).

    `theta` (m,): temperature less the reference [K].
    """

    columns: Array
    candidates: Array
    y: Array
    block: Index
    weight: Array
    theta: Array

    def fit(self, selected: Sequence[int]) -> LeastSquares:
        """Fit with some of the candidates."""
        X = np.hstack([self.columns, self.candidates[:, list(selected)]])
        return solve_least_squares(X, self.y[:, None], self.block, self.weight)


def _fit_channel(problem: _Problem, level: float) -> tuple[Array, Array]:
    """Coefficients (q,) and covariance (q, q) of a channel.

    Where any candidate is significant the channel has all that the rows tell: one that is left out because its error is
    large would count as known to be zero.
    """
    p, q = problem.columns.shape[1], problem.candidates.shape[1]
    coefficients, covariance = np.zeros(q), np.zeros((q, q))
    open_terms = _independent_candidates(problem)
    by_zeros = _zeros_over_temperature(problem.fit([]), problem, level)
    if not by_zeros and not _any_significant(problem, open_terms, level):
        return coefficients, covariance
    fit = problem.fit(open_terms)
    own_sigma = fit.sigma[p + open_terms.index(0), 0] if 0 in open_terms else np.inf
    if by_zeros and by_zeros[1] < own_sigma:
        open_terms = [term for term in open_terms if term != 0]
        by_zeros = _zeros_over_temperature(problem.fit(open_terms), problem, level) or by_zeros
        coefficients[0], covariance[0, 0] = by_zeros[0], by_zeros[1] ** 2
        problem = replace(problem, y=problem.y - by_zeros[0] * problem.theta)
        if not _any_significant(problem, open_terms, level):
            return coefficients, covariance
        fit = problem.fit(open_terms)
    coefficients[open_terms] = fit.coefficients[p:, 0]
    covariance[np.ix_(open_terms, open_terms)] = fit.inverse[p:, p:] * fit.variance[0]
    return coefficients, covariance


def _unseen_drift(problem: _Problem, loads: Array) -> Array:
    """Mean squares (k,) [V2/N2 K2] of changes of sensitivity that are not significant: what the rows allow, or usual.

    The usual change is a share of the sensitivity itself, by the loads (m, k) alone.
    """
    X, y = (subtract_block_means(values, problem.block) for values in (loads, problem.y[:, None]))
    usual = (USUAL_DRIFT * np.linalg.lstsq(X, y, rcond=None)[0][:, 0]) ** 2
    open_terms = [term for term in _independent_candidates(problem) if term > 0]
    if not open_terms:
        return np.asarray(usual)
    p, fit = problem.columns.shape[1], problem.fit(open_terms)
    allowed = np.full(loads.shape[1], np.inf)
    if fit.dof >= MIN_DOF:
        allowed[np.array(open_terms) - 1] = fit.coefficients[p:, 0] ** 2 + fit.sigma[p:, 0] ** 2
    return np.asarray(np.minimum(usual, allowed))


def _any_significant(problem: _Problem, terms: Sequence[int], level: float) -> bool:
    """Whether one of the candidates is significant by itself, or all together, beside the other columns."""
    if not terms:
        return False
    p, full = problem.columns.shape[1], problem.fit(terms)
    if full.dof < MIN_DOF:
        return False
    if any(problem.fit([term]).p_value[p, 0] < level for term in terms):
        return True
    none = problem.fit([])
    gain = none.variance[0] * none.dof - full.variance[0] * full.dof
    ratio = gain / len(terms) / max(float(full.variance[0]), np.finfo(float).tiny)
    return bool(stats.f.sf(max(ratio, 0.0), len(terms), full.dof) < level)


def _independent_candidates(problem: _Problem) -> list[int]:
    """Candidates that zeros and the other columns do not explain."""
    basis = subtract_block_means(problem.columns, problem.block)
    columns = subtract_block_means(problem.candidates, problem.block)
    left = columns - basis @ np.linalg.lstsq(basis, columns, rcond=None)[0]
    size = np.linalg.norm(problem.candidates, axis=0)
    is_independent = np.linalg.norm(left, axis=0) > MIN_INDEPENDENT_SHARE * np.where(size > 0, size, np.inf)
    return np.flatnonzero(is_independent).tolist()


def _biweight(rows: TemperatureRows, candidates: Array, channel: int) -> Array:
    """Weights (m,) of Tukey's biweight, by a fit with all terms of temperature that the rows tell."""
    y, weight = rows.channels[:, channel], rows.weight.copy()
    problem = _Problem(rows.columns[channel], candidates, y, rows.load_series, weight, candidates[:, 0])
    all_terms = _independent_candidates(problem)
    for _ in range(ROBUST_ITERATIONS):
        try:
            fit = replace(problem, weight=weight).fit(all_terms)
        except CollinearError:
            return rows.weight
        if fit.dof < MIN_DOF:
            return rows.weight
        errors = fit.residuals[:, 0] * np.sqrt(rows.weight)
        scale = max(1.4826 * float(np.median(np.abs(errors))), np.finfo(float).tiny)
        share = np.clip(1.0 - (errors / (TUKEY * scale)) ** 2, 0.0, None) ** 2
        weight = rows.weight * np.maximum(share, MIN_WEIGHT)
    return weight


def _zeros_over_temperature(fit: LeastSquares, problem: _Problem, level: float) -> tuple[float, float] | None:
    """Slope [V/K] of the zeros of the load series over their mean temperatures, with its error; None without one."""
    series = np.unique(problem.block)
    if len(series) < MIN_ZEROS:
        return None
    at = [problem.block == number for number in series]
    means = np.array([np.average(problem.theta[rows], weights=problem.weight[rows]) for rows in at])
    centered = means - means.mean()
    squares = float(centered @ centered)
    if squares <= (MIN_INDEPENDENT_SHARE * np.ptp(problem.theta)) ** 2:
        return None
    zeros = fit.zeros[:, 0]
    slope = float(centered @ zeros) / squares
    residual = zeros - zeros.mean() - slope * centered
    dof = len(series) - 2
    sigma = float(np.sqrt(max(residual @ residual, np.finfo(float).tiny) / dof / squares))
    return (slope, sigma) if 2.0 * stats.t.sf(abs(slope) / sigma, dof) < level else None
