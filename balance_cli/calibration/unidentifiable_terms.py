"""Terms beyond those that a model has, whose effect on combined loads the schedule does not tell.

Aliases. In a schedule that applied loads in some directions only, several terms do the same: F^2 and F|F| of a load
that was applied to one side, F G and |F| G of two that were applied together to one side. The model has one of them;
the others are as likely. Beyond the schedule they differ, and their mean square difference is an error of the model.

Products of third degree. The ten families have none. A channel that curves with its own signal s, by q s^3, has the
cubes q s_i^3, and with them the products 3 q s_i^2 s_j and 6 q s_i s_j s_k. Their standard deviation is therefore
3 and 6 times the rms of what the loads cause that is odd and nonlinear, or less: the residuals of rows with two loads
tell the variance of F^2 G (Rao, J. Multivariate Anal. 1, 1971, 257), as far as the terms do not absorb it. What both
cause beyond the rows comes beside the residuals. Where rows with three loads would show them, nothing does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.block_zeros import subtract_block_means
from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.term_support import MIN_INDEPENDENT_SHARE
from balance_cli.calibration.terms import ABSOLUTE, CONSTANT, Term, all_terms, term_values

Array = NDArray[np.float64]
Index = NDArray[np.intp]

FOUND_FROM = 4.0
"""Standard errors from which a term is found: the level 0.01 over some 100 terms and 8 channels is |t| of 4."""
SQUARE_PRODUCT, TRIPLE_PRODUCT = 3.0, 6.0
"""Coefficients of F^2 G and F G H over the geometric means of the cubes, for a cubic function of one signal."""


@dataclass(frozen=True)
class AliasedTerms:
    """Differences between terms and what does the same in the rows, as functions of loads over their range.

    Difference d at loads x (m, k) is values of `terms` and loads times `weights` (t + k, d); `variance` (d, c) [V2]: of
    the square of the coefficient in each channel, over the number of possible terms.
    """

    terms: tuple[Term, ...]
    weights: Array
    variance: Array

    def reading_variance(self, x: Array) -> Array:
        """Variance (m, c) [V2] of the readings at loads x (m, k) over their range."""
        return np.asarray((np.hstack([term_values(self.terms, x), x]) @ self.weights) ** 2 @ self.variance)


@dataclass(frozen=True)
class CubicProducts:
    """Products of third degree: `variance` (c,) [V2] of a cube, and their `mean_square` in the residuals of rows."""

    variance: Array
    mean_square: float

    def reading_variance(self, x: Array) -> Array:
        """Variance (m, c) [V2] of the readings at loads x (m, k) over their range, beyond that in the rows."""
        beyond = np.maximum(np.sum(_cubic_products(x) ** 2, axis=1) - self.mean_square, 0.0)
        return np.asarray(beyond[:, None] * self.variance)


def find_aliased_terms(model: CalibrationModel, x: Array, block: Index) -> AliasedTerms | None:
    """Find the terms that do what nonlinear terms of the model do in rows x (m, k), with a zero for each block (m,)."""
    k = len(model.components)
    terms = all_terms(k)
    values = term_values(terms, x)
    columns = subtract_block_means(values, block)
    projection = np.linalg.lstsq(columns[:, :k], columns, rcond=None)[0]
    left = columns - columns[:, :k] @ projection
    size = np.linalg.norm(left, axis=0)
    known = size > MIN_INDEPENDENT_SHARE * np.linalg.norm(values, axis=0)
    unit = left / np.where(size > 0.0, size, 1.0)
    same = np.abs(unit.T @ unit) > 1.0 - 0.5 * MIN_INDEPENDENT_SHARE**2
    own = {term: model.coefficients[place] for place, term in enumerate(model.parsed_terms)}
    weights, variance = [], []
    for p, term in enumerate(terms[k:], k):
        if term not in own or not known[p]:
            continue
        others = [a for a in np.flatnonzero(same[p] & known).tolist() if a >= k and terms[a] not in own]
        for a in others:
            ratio = float(unit[:, a] @ unit[:, p]) * size[p] / size[a]
            weight = np.zeros(len(terms) + k)
            weight[a], weight[p] = ratio, -1.0
            weight[len(terms) :] = projection[:, p] - ratio * projection[:, a]
            weights.append(weight)
            variance.append(own[term] ** 2 / (1.0 + len(others)))
    for p in np.flatnonzero(_is_one_sided(terms, known, size)).tolist():
        weight = np.zeros(len(terms) + k)
        weight[p] = 1.0
        weight[len(terms) :] = -projection[:, p]
        weights.append(weight)
        variance.append(_side_variance(model))
    return AliasedTerms(terms, np.array(weights).T, np.array(variance)) if weights else None


def _is_one_sided(terms: Sequence[Term], known: NDArray[np.bool_], size: Array) -> NDArray[np.bool_]:
    """Terms |F| of loads that were applied to one side only, in which |F| is F itself."""
    is_side = np.array([term.function == ABSOLUTE and term.other_function == CONSTANT for term in terms])
    return np.asarray(is_side & ~known & np.isfinite(size))


def _side_variance(model: CalibrationModel) -> Array:
    """Variance (c,) [V2] of a term |F|: that of the other loads', with the errors of their coefficients."""
    terms = model.parsed_terms
    at = [p for p, term in enumerate(terms) if term.function == ABSOLUTE and term.other_function == CONSTANT]
    unit = _largest_response(model)
    if not at:
        return np.zeros(len(unit))
    squares = model.coefficients[at].T ** 2 + np.diagonal(model.covariance, axis1=1, axis2=2)[:, at]
    return np.asarray(unit**2 * np.mean(squares / unit[:, None] ** 2))


def find_cubic_products(model: CalibrationModel, x: Array, readings: Array, block: Index) -> CubicProducts | None:
    """What products of third degree may cause beyond rows x (m, k) and their `readings` (m, c) [V].

    Each block (m,) has its own zero.

    None where no channel has an odd nonlinear part, and where the rows would show products of three loads.
    """
    sigma = _odd_size(model)
    if not np.any(sigma > 0.0) or x.shape[1] < 2:
        return None
    values = term_values(model.parsed_terms, x)
    columns = np.hstack([_cubic_products(x), readings - values @ model.coefficients])
    terms, columns = subtract_block_means(values, block), subtract_block_means(columns, block)
    left = columns - terms @ np.linalg.lstsq(terms, columns, rcond=None)[0]
    k, c = x.shape[1], readings.shape[1]
    squares, triples, residuals = left[:, : k * (k - 1)], left[:, k * (k - 1) : -c], left[:, -c:]
    noise = np.diag(model.residual_covariance)
    shown = float(np.mean(np.sum(triples**2, axis=0))) if triples.size else np.inf
    if np.all(sigma**2 * shown >= FOUND_FROM**2 * noise):
        return None
    mean_square = float(np.sum(squares**2) + np.sum(triples**2)) / len(x)
    unit = _largest_response(model) ** 2
    estimates = _quadratic_estimates(squares, residuals, noise)
    return CubicProducts(unit * _shared_variance(*(v / unit for v in (*estimates, sigma**2))), mean_square)


def _quadratic_estimates(columns: Array, residuals: Array, noise: Array) -> tuple[Array, Array]:
    """Variances (c,) [V2] of coefficients of columns (m, q) in residuals (m, c) with `noise` (c,), and their sigma."""
    size = float(np.linalg.norm(columns.T @ columns))
    if size <= np.finfo(float).tiny:
        return np.zeros(len(noise)), np.full(len(noise), np.inf)
    estimates = (np.sum((columns.T @ residuals) ** 2, axis=0) - noise * np.sum(columns**2)) / size**2
    return estimates, np.sqrt(2.0) * noise / size


def _shared_variance(estimates: Array, sigma: Array, prior: Array) -> Array:
    """Variances (c,) of channels, over their response, from `estimates` with `sigma` and from a `prior` (c,).

    A variance is not negative: chance alone would leave two fifths of sigma in each channel. The channels therefore
    share one variance, as far as they do not differ by more than chance (DerSimonian and Laird, Control. Clin. Trials
    7, 1986, 177), and each is moved toward it (empirical Bayes). The prior, whose standard deviation is its size, is
    weighted with that.
    """
    if not np.isfinite(sigma).all():
        return prior
    weight = 1.0 / np.maximum(sigma, np.finfo(float).tiny) ** 2
    total = float(np.sum(weight))
    common = float(weight @ estimates) / total
    excess = float(weight @ (estimates - common) ** 2) - (len(estimates) - 1)
    spread = max(excess / max(total - float(np.sum(weight**2)) / total, np.finfo(float).tiny), 0.0)
    own = spread / (spread + sigma**2)
    moved = own * estimates + (1.0 - own) * common
    variance = own * sigma**2 + (1.0 - own) ** 2 / total
    combined = (moved * prior**2 + prior * variance) / np.maximum(prior**2 + variance, np.finfo(float).tiny)
    return np.asarray(np.clip(combined, 0.0, prior))


def _odd_size(model: CalibrationModel) -> Array:
    """Odd nonlinear part (c,) [V] of a load at its calibrated range, rms over the loads; like channels share theirs."""
    k = len(model.components)
    up, down = (term_values(model.parsed_terms[k:], side * np.eye(k)) for side in (1.0, -1.0))
    odd = 0.5 * (up - down) @ model.coefficients[k:]
    linear = _largest_response(model)
    share = np.sqrt(np.mean(odd**2, axis=0)) / linear
    return np.asarray(linear * np.maximum(share, np.sqrt(np.mean(share**2))))


def _largest_response(model: CalibrationModel) -> Array:
    """Largest linear coefficient (c,) [V] of each channel, to which its other terms are related."""
    largest = np.max(np.abs(model.coefficients[: len(model.components)]), axis=0)
    return np.asarray(np.maximum(largest, np.finfo(float).tiny))


def _cubic_products(x: Array) -> Array:
    """Values (m, q) of all products of third degree at loads x (m, k), in units of a cube."""
    k = x.shape[1]
    squares = [SQUARE_PRODUCT * x[:, i] ** 2 * x[:, j] for i, j in permutations(range(k), 2)]
    triples = [TRIPLE_PRODUCT * x[:, i] * x[:, j] * x[:, h] for i, j, h in combinations(range(k), 3)]
    return np.array([*squares, *triples]).T
