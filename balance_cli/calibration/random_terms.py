"""A calibration model for loads whose nonlinear terms are random: none is selected, each family has a variance.

A search names the terms that are significant. Many small terms of which none is significant act on the loads all the
same, and a selected one takes what belongs to those that the schedule does not tell from it: extrapolated to a
direction that was not applied, it errs. For the loads every nonlinear term of a few families is therefore given a
coefficient with a variance that its family has in common, and is shrunk by it; what the rows do not tell remains in the
covariance. The slopes of a load series scatter too (weights that are not aligned, a gain that drifts): their variance
keeps a term from explaining one series, and is part of the error of new loads. Where few terms of significant size
explain the readings decisively better, the selected terms compute the loads.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.block_zeros import subtract_block_means
from balance_cli.calibration.fit import CalibrationModelFit, CalibrationPoints, ChannelFits, assemble_fit
from balance_cli.calibration.least_squares import LeastSquares
from balance_cli.calibration.penalized_regression import solve_penalized
from balance_cli.calibration.repeated_tares import repeated_tares
from balance_cli.calibration.selection import MIN_DOF
from balance_cli.calibration.term_support import MIN_INDEPENDENT_SHARE
from balance_cli.calibration.terms import (
    ABSOLUTE,
    CONSTANT,
    IDENTITY,
    SIGNED_SQUARE,
    SQUARE,
    Term,
    all_terms,
    linear_terms,
    term_values,
)
from balance_cli.calibration.variance_components import VarianceComponents, estimate_variance_components
from balance_cli.calibration.weight_covariance import correlation_shrinkage

Array = NDArray[np.float64]
Index = NDArray[np.intp]

FAMILIES = ((ABSOLUTE, CONSTANT), (SQUARE, CONSTANT), (SIGNED_SQUARE, CONSTANT), (IDENTITY, IDENTITY))
"""Functions of the families |F|, F^2, F|F| and F G. Cubes beside them made loads beyond those applied worse (1.06 times
the error of the best least squares where the largest loads are left out, 0.94 without), and no others better."""
DECISIVE_EVIDENCE = 20.0
"""Log odds from which the selected terms compute the loads. Up to 40 both predicted series that were left out equally
well in the median, and up to 20 either was at times twice as good; balances with few large terms have 2000 and more."""
MAX_SLOPES = 300
"""Columns of slopes of load series beyond which there are none: the time grows with their cube, to 2 s for so many."""
SAME_LIKELIHOOD = 3.0
"""Log likelihood that slopes of the load series have to gain: odds of 20, "strong" (Kass and Raftery, J. Am. Stat.
Assoc. 90, 1995, 773). A term |F| and a gain error of one of two series of opposite directions have the same effect. If
it was a gain, |F| makes the errors of further series sqrt(4/3) times those of the mean slope, which is wrong by |F| if
it was that."""
FAMILY_COST = 1.0
"""Log likelihood that each variance has to gain (Akaike, IEEE Trans. Autom. Control 19, 1974, 716)."""


@dataclass(frozen=True)
class _Columns:
    """Values (m, k + p + q) of the loads, of nonlinear `terms`, and of the loads in each series; family (p + q,)."""

    values: Array
    terms: tuple[Term, ...]
    family: Index
    slopes: int

    @property
    def loads(self) -> int:
        """Number of loads."""
        return int(self.values.shape[1] - len(self.family))


def fit_random_terms(points: CalibrationPoints, fit: CalibrationModelFit) -> CalibrationModelFit | None:
    """Fit the loads, and the nonlinear terms that the rows tell with random coefficients, to the rows of a `fit`.

    None where the terms of `fit`, which were selected, have decisively more evidence, or where none was selected and
    the loads alone have more; where no coefficient but those of the loads is determined, or the rows are too few.
    """
    points = points.exclude_rows(~np.asarray(np.isfinite(fit.residuals).all(axis=1)))
    used = points.weight > 0
    block, weight = points.load_series[used], points.weight[used]
    columns = _determined_columns(points.x[used], block)
    k, rows_less_zeros = columns.loads, len(block) - len(np.unique(block))
    if not len(columns.family) or rows_less_zeros - k < MIN_DOF:
        return None
    A, y = (subtract_block_means(values, block, weight) for values in (columns.values, points.channels[used]))
    response = np.sqrt(np.mean(np.linalg.lstsq(A[:, :k], y, rcond=None)[0] ** 2, axis=0))
    scale = np.where(response > 0.0, response, 1.0)
    components = estimate_variance_components(A[:, :k], A[:, k:], columns.family, y, scale, rows_less_zeros)
    scatter = float(components.size[-1]) if columns.slopes else 0.0
    if scatter:
        columns, components = _prefer_terms(columns, components, A, y, rows_less_zeros)
    if not components.size.any():
        return None
    share = _independent_share(A[:, :k], y, rows_less_zeros)
    evidence = share * components.log_likelihood - FAMILY_COST * np.count_nonzero(components.size)
    candidates = k * (2 * k + 3)  # nonlinear terms of the ten families
    required = DECISIVE_EVIDENCE if fit.model.is_nonlinear else 0.0
    if evidence + required <= _evidence_of_selected(fit, weight, used, rows_less_zeros, candidates, share):
        return None
    return _fit_channels(points, columns, components, scatter)


def _prefer_terms(
    columns: _Columns, components: VarianceComponents, A: Array, y: Array, rows_less_zeros: int
) -> tuple[_Columns, VarianceComponents]:
    """The columns without the slopes of load series, and their variances, where these explain as much alone."""
    k, terms = columns.loads, columns.values.shape[1] - columns.slopes
    if terms == k:
        return columns, components
    family = columns.family[: terms - k]
    without = estimate_variance_components(A[:, :k], A[:, k:terms], family, y, components.scale, rows_less_zeros)
    if without.log_likelihood < components.log_likelihood - SAME_LIKELIHOOD:
        return columns, components
    return _Columns(columns.values[:, :terms], columns.terms, family, 0), without


def _independent_share(columns: Array, y: Array, rows_less_zeros: int) -> float:
    """Number of channels that tell as much as all of y (m, c) do, over their number.

    The error of a load is common to all channels, and so is the curvature that it feigns: each would count it anew.
    With the correlations R of what the columns leave, shrunk by what chance makes of them, it is (tr R)^2 / tr R^2
    (Kish, Survey Sampling, 1965, for the variance of a mean).
    """
    left = y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0]
    dof = rows_less_zeros - np.linalg.matrix_rank(columns)
    if dof < 1:
        return 1.0
    covariance = left.T @ left / dof
    weight = 1.0 - correlation_shrinkage(covariance, float(dof))
    sigma = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
    others = (covariance / sigma[:, None] / sigma)[~np.eye(len(sigma), dtype=bool)]
    return float(1.0 / (1.0 + np.sum((weight * others) ** 2) / len(sigma)))


def _determined_columns(x: Array, block: Index) -> _Columns:
    """The columns that zeros and loads do not explain.

    Terms that equal each other in this schedule all remain: they share what is found.
    """
    k = x.shape[1]
    terms = [term for term in all_terms(k) if (term.function, term.other_function) in FAMILIES]
    number = [FAMILIES.index((term.function, term.other_function)) for term in terms]
    slopes = _series_slopes(x, block)
    values = np.hstack([term_values((*linear_terms(k), *terms), x), slopes])
    family = np.array([*number, *[len(FAMILIES)] * slopes.shape[1]], np.intp)
    centered = subtract_block_means(values, block)
    basis = np.linalg.qr(centered[:, :k])[0]
    left = centered[:, k:] - basis @ (basis.T @ centered[:, k:])
    determined = np.linalg.norm(left, axis=0) > MIN_INDEPENDENT_SHARE * np.linalg.norm(values[:, k:], axis=0)
    names = np.unique(family[determined])
    return _Columns(
        values=np.hstack([values[:, :k], values[:, k:][:, determined]]),
        terms=(*linear_terms(k), *(term for term, is_kept in zip(terms, determined, strict=False) if is_kept)),
        family=np.searchsorted(names, family[determined]),
        slopes=int(np.count_nonzero(determined[len(terms) :])),
    )


def _series_slopes(x: Array, block: Index) -> Array:
    """The loads (m, q) of each load series, zero in the others; those that are constant in it are its zero."""
    names, series = np.unique(block, return_inverse=True)
    if len(names) > MAX_SLOPES:
        return np.zeros((len(x), 0))
    each = (np.eye(len(names))[series][:, :, None] * x[:, None, :]).reshape(len(x), -1)
    varied = np.linalg.norm(subtract_block_means(each, block), axis=0) > 0.0
    return np.asarray(each[:, varied] if np.count_nonzero(varied) <= MAX_SLOPES else each[:, :0])


def _evidence_of_selected(
    fit: CalibrationModelFit,
    weight: Array,
    used: NDArray[np.bool_],
    rows_less_zeros: int,
    candidates: int,
    share: float,
) -> float:
    """Log likelihood of the selected terms less what they cost: ln n / 2, and ln p for the choice among p candidates.

    The extended Bayesian information criterion (Chen and Chen, Biometrika 95, 2008, 759), on the scale of the
    restricted likelihood.
    """
    k = len(fit.model.components)
    n = rows_less_zeros - k
    squares = np.maximum(weight @ fit.residuals[used] ** 2, np.finfo(float).tiny)
    selected = np.count_nonzero(np.isfinite(fit.model.t[k:]))
    return float(-0.5 * share * np.sum(n * np.log(squares / n) + n) - selected * (0.5 * np.log(n) + np.log(candidates)))


def _fit_channels(
    points: CalibrationPoints, columns: _Columns, components: VarianceComponents, scatter: float
) -> CalibrationModelFit:
    """Fit all channels, each coefficient penalized by the noise over its standard deviation.

    `scatter`: what slopes of load series scatter by, relative to the response of a channel.
    t, p-value and variance inflation are those of the loads; a random coefficient has none.
    """
    used, k = points.weight > 0, columns.loads
    size = components.size[columns.family]
    X = columns.values[:, np.r_[np.ones(k, bool), size > 0.0]]
    terms = [*columns.terms[:k], *(term for term, own in zip(columns.terms[k:], size, strict=False) if own > 0.0)]
    fits = []
    for c, y in enumerate(points.channels[used].T):
        penalty = np.r_[np.zeros(k), components.noise[c] / (components.scale[c] * size[size > 0.0])]
        fit = solve_penalized(X, y, points.load_series[used], points.weight[used], penalty)
        fits.append(_without_slopes(fit, len(terms), k, scatter * float(components.scale[c])))
    selected = (tuple(range(len(terms))),) * len(fits)
    groups = tuple((c,) for c in range(len(fits)))
    result = assemble_fit(ChannelFits(points, used, X[:, : len(terms)], selected, groups, tuple(fits)), terms, {})
    unknown = np.full((len(terms) - k, len(fits)), np.nan)
    model = result.model
    t, p_value, inflation = (np.vstack([v[:k], unknown]) for v in (model.t, model.p_value, model.variance_inflation))
    # The coefficients' variances and the noise together are told by what zeros, loads and repeated tares leave.
    tare, series = repeated_tares(points.x[used]), points.load_series[used]
    repeats = np.count_nonzero(tare) - len(np.unique(series[tare]))
    dof = np.full(len(fits), max(len(series) - len(np.unique(series)) - k - repeats, 1.0))
    return replace(result, model=replace(model, t=t, p_value=p_value, variance_inflation=inflation, dof=dof))


def _without_slopes(fit: LeastSquares, terms: int, k: int, scatter: float) -> LeastSquares:
    """The fit of the first `terms` columns; what slopes of load series scatter by is an error of the k loads."""
    inverse = fit.inverse[:terms, :terms].copy()
    inverse[np.arange(k), np.arange(k)] += scatter**2 / max(float(fit.variance[0]), np.finfo(float).tiny)
    return replace(fit, coefficients=fit.coefficients[:terms], root=fit.root[:terms, :terms], inverse=inverse)
