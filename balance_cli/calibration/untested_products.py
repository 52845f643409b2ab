"""Products of two loads that a load schedule cannot tell, and how large they may be.

Where each load was applied by itself, the readings tell how they curve with that load, and nothing of what two loads
cause together. A channel that curves with its own signal s, by q s^2, has the squares q s_i^2 and the products
2 q s_i s_j: twice the geometric mean of two squares. Therefore a product that was not tested has an unknown coefficient
of zero mean, with PRODUCT_OVER_SQUARE times the rms of the channel's nonlinear parts as its standard deviation. What
the schedule tells of it is combined with that by Bayes' rule; a product that would have been found is tested. The
products that the schedule tells are as good a sample of the others, and share in that standard deviation.
A model without nonlinear terms has no such products: no load says that the balance is not linear.

A product of a varied load with one that hangs changes the gain of a channel. Where one load series alone has both, a
wrong gain in that series looks the same: the product is real or it is zero, and nothing says which. With even odds the
mean square error of the fitted coefficient b is b^2/2, and the 95 % interval, 1.4 b to both sides, contains both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from balance_cli.calibration.block_zeros import subtract_block_means
from balance_cli.calibration.math_model import CalibrationModel, weighted_inverse
from balance_cli.calibration.term_support import MIN_APPLIED_LOAD
from balance_cli.calibration.terms import Term, linear_terms, term_values
from balance_cli.calibration.unidentifiable_terms import (
    FOUND_FROM,
    AliasedTerms,
    CubicProducts,
    find_aliased_terms,
    find_cubic_products,
)

Array = NDArray[np.float64]
Index = NDArray[np.intp]

PRODUCT_OVER_SQUARE = 2.0
"""Coefficient of a product over the geometric mean of the squares, for a quadratic function of one signal."""
LEVELS = np.linspace(-1.0, 1.0, 9)
"""Loads over their range at which the nonlinear part of a channel is taken: the steps of usual load series."""
MOST_NAMED = 3
"""Products that a sentence names."""
MIN_NAMED_PRODUCT = 0.01
"""Product of two full loads over the largest linear response from which it may be a gain error of its load series.

Below a gain error of 1 % no load series is suspected of a fault, and most balances have such products.
"""
MIN_CURVED_SHARE = 0.1
"""Part of a product within its load series that the loads must not explain: then no gain error looks like it."""
MIN_SIGMA_GROWTH = 1.1
"""Growth of sigma from which a load is outside the tested combinations: a tenth is what sigma itself is known to."""


@dataclass(frozen=True)
class UntestedProducts:
    """Products of two loads with their `variance` (q, c) [V2] in each channel, both loads at their calibrated range.

    `pairs` (q, 2): indices of the loads; `calibrated_range` (k,) [N, N m]. `aliased`, `cubic`: further terms that the
    schedule does not tell, None where there are none.
    """

    components: tuple[str, ...]
    pairs: Index
    variance: Array
    calibrated_range: Array
    aliased: AliasedTerms | None = None
    cubic: CubicProducts | None = None

    def reading_variance(self, loads: ArrayLike) -> Array:
        """Variance (m, c) [V2] of the readings at loads (m, k) [N, N m] by the terms that were not tested."""
        x = np.atleast_2d(np.asarray(loads, float)) / self.calibrated_range
        products = x[:, self.pairs[:, 0]] * x[:, self.pairs[:, 1]]
        further = (part.reading_variance(x) for part in (self.aliased, self.cubic) if part is not None)
        return np.asarray(sum(further, products**2 @ self.variance))

    def describe(self, loads: Array) -> tuple[str, ...]:
        """What was not tested and matters at loads (k,) [N, N m], in words."""
        names, x = self.names(loads), np.atleast_2d(loads) / self.calibrated_range
        more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
        parts = [f"the products {', '.join(names[:MOST_NAMED])}{more}"] if names else []
        if self.aliased is not None and np.any(self.aliased.reading_variance(x) > 0.0):
            parts.append("which of terms that do the same in them are there")
        if self.cubic is not None and np.any(self.cubic.reading_variance(x) > 0.0):
            parts.append("products of third degree")
        return tuple(parts)

    def reading_covariance(self, loads: ArrayLike, rows: Index) -> Array:
        """Covariance (m, c, c) [V2] of some channels (rows) at loads (m, k): those of two channels are independent."""
        return self.reading_variance(loads)[:, rows, None] * np.eye(len(rows))

    def load_covariance(self, model: CalibrationModel, loads: ArrayLike, rows: Index | None = None) -> Array:
        """Covariance (m, k, k) of loads (m, k) [N, N m] that the model computes from some channels (rows)."""
        at = np.arange(len(model.channel_names)) if rows is None else rows
        weighting = model.weight_covariance(at)
        W = weighted_inverse(model.jacobian(loads, at), weighting)
        covariance = (W * self.reading_variance(loads)[:, None, at]) @ W.swapaxes(1, 2)
        return np.asarray(covariance * model.calibrated_range[:, None] * model.calibrated_range)

    def names(self, loads: ArrayLike) -> tuple[str, ...]:
        """The products as terms are called, those first that cause most at loads (k,) [N, N m]; no others."""
        if not len(self.pairs):
            return ()
        x = np.asarray(loads, float) / self.calibrated_range
        unit = np.maximum(self.variance.max(axis=0), np.finfo(float).tiny)
        caused = (x[self.pairs[:, 0]] * x[self.pairs[:, 1]]) ** 2 * (self.variance / unit).sum(axis=1)
        order = [place for place in np.argsort(-caused).tolist() if caused[place] > 0.0]
        return tuple(f"{self.components[i]} {self.components[j]}" for i, j in self.pairs[order])


def find_untested_products(
    model: CalibrationModel, loads: Array, readings: Array, load_series: Index
) -> UntestedProducts | None:
    """Find the terms that loads (m, k) [N, N m] and readings (m, c) [V] could not tell; None where there are none.

    `load_series` (m,): number of the load series of each row, with its own zero. None, too, for a linear model, and
    for one that was read from a matrix, whose rows are not known.
    """
    if not model.is_nonlinear or not len(loads):
        return None
    pairs = np.array([*combinations(range(len(model.components)), 2)], np.intp).reshape(-1, 2)
    information = _information(model, loads, load_series, pairs)
    scale = np.maximum(np.diag(model.residual_covariance), np.finfo(float).tiny)
    prior = np.maximum(_prior_sigma(model) ** 2, np.finfo(float).tiny)
    gain = information[:, None] * prior / scale
    is_open = (gain < FOUND_FROM**2) & ~_has_product(model, pairs)
    prior = _with_told_products(prior, _products(model, pairs), is_open)
    variance = np.where(is_open, prior / (1.0 + information[:, None] * prior / scale), 0.0)
    variance += _gain_like_variance(model, loads / model.calibrated_range, load_series, pairs)
    some = (variance > 0.0).any(axis=1)
    x = loads / model.calibrated_range
    aliased = find_aliased_terms(model, x, load_series)
    cubic = find_cubic_products(model, x, readings, load_series)
    if not some.any() and aliased is None and cubic is None:
        return None
    return UntestedProducts(model.components, pairs[some], variance[some], model.calibrated_range, aliased, cubic)


def _prior_sigma(model: CalibrationModel) -> Array:
    """Standard deviation (c,) [V] of an unknown product; channels alike share what is found of their curvature."""
    k = len(model.components)
    linear = np.maximum(np.max(np.abs(model.coefficients[:k]), axis=0), np.finfo(float).tiny)
    share = _nonlinear_size(model) / linear
    return np.asarray(PRODUCT_OVER_SQUARE * linear * np.maximum(share, np.sqrt(np.mean(share**2))))


def _nonlinear_size(model: CalibrationModel) -> Array:
    """Largest nonlinear part [V] that each channel (c,) has of a load, rms over the loads that were applied alone."""
    k, parts = len(model.components), []
    terms = model.parsed_terms
    limits = np.stack([model.smallest_load, model.largest_load]) / model.calibrated_range
    for j in range(k):
        x = np.zeros((len(LEVELS), k))
        x[:, j] = np.clip(LEVELS, limits[0, j], limits[1, j])
        parts.append(np.max(np.abs(term_values(terms[k:], x) @ model.coefficients[k:]), axis=0))
    products = [column for term, column in zip(terms, model.coefficients, strict=True) if not term.single_load]
    sizes = np.array([*parts, *np.abs(products)])
    return np.asarray(np.sqrt(np.sum(sizes**2, axis=0) / k))


def _information(model: CalibrationModel, loads: Array, block: Index, pairs: Index) -> Array:
    """Sum of squares (q,) of each product in the schedule, less what zeros and the terms of single loads explain."""
    x = loads / model.calibrated_range
    single = [term for term in model.parsed_terms if term.single_load]
    basis = subtract_block_means(term_values((*linear_terms(x.shape[1]), *single), x), block)
    products = subtract_block_means(x[:, pairs[:, 0]] * x[:, pairs[:, 1]], block)
    left = products - basis @ np.linalg.lstsq(basis, products, rcond=None)[0]
    return np.asarray(np.sum(left**2, axis=0))


def gain_like_products(model: CalibrationModel, x: Array, load_series: Index) -> list[int]:
    """Indices of the terms of two loads that a wrong gain in the one load series that tells them would look like.

    `x` (m, k): loads of the rows that were fitted, over their calibrated range. A single load series has no such terms:
    there is no gain but its own.
    """
    applied = np.abs(x) > MIN_APPLIED_LOAD
    return [
        place
        for place, term in enumerate(model.parsed_terms)
        if not term.single_load
        and len(own := np.unique(load_series[applied[:, term.i] & applied[:, term.j]])) == 1
        and np.any(load_series != own[0])
        and _is_linear_in(x[load_series == own[0]], term)
    ]


def _is_linear_in(x: Array, term: Term) -> bool:
    """Whether zero and loads x (m, k) explain a term in these rows, as where one of its loads hangs."""
    values = term_values((term,), x)
    change = values - values.mean(axis=0)
    centered = x - x.mean(axis=0)
    left = change - centered @ np.linalg.lstsq(centered, change, rcond=None)[0]
    return bool(np.linalg.norm(left) <= MIN_CURVED_SHARE * np.linalg.norm(change))


def _gain_like_variance(model: CalibrationModel, x: Array, load_series: Index, pairs: Index) -> Array:
    """Variance (q, c) [V2] of the products that may be a gain error of their load series: half of their square."""
    variance = np.zeros((len(pairs), len(model.channel_names)))
    number = {tuple(pair): q for q, pair in enumerate(pairs.tolist())}
    largest = np.max(np.abs(model.coefficients[: len(model.components)]), axis=0)
    for place in gain_like_products(model, x, load_series):
        size = np.abs(model.coefficients[place])
        doubtful = np.where(size > MIN_NAMED_PRODUCT * largest, 0.5 * size**2, 0.0)
        variance[number[model.parsed_terms[place].loads]] += doubtful
    return variance


def _has_product(model: CalibrationModel, pairs: Index) -> NDArray[np.bool_]:
    """Whether (q, c) the model of a channel has a term of both loads."""
    return np.asarray(_products(model, pairs) != 0.0)


def _products(model: CalibrationModel, pairs: Index) -> Array:
    """Coefficients (q, c) [V] of the terms of both loads, of several the root of the sum of their squares."""
    square = np.zeros((len(pairs), len(model.channel_names)))
    place = {tuple(pair): number for number, pair in enumerate(pairs.tolist())}
    for term, column in zip(model.parsed_terms, model.coefficients, strict=True):
        if not term.single_load:
            square[place[term.loads]] += column**2
    return np.sqrt(square)


def _with_told_products(prior: Array, products: Array, is_open: NDArray[np.bool_]) -> Array:
    """Return the variance (c,) of products that are open (q, c), by those that the schedule tells, zeros among them.

    The variance by the squares counts as one product more.
    """
    determined = ~is_open
    return np.asarray((prior + np.sum(determined * products**2, axis=0)) / (1.0 + np.count_nonzero(determined, axis=0)))


def untested_components(components: Sequence[str], variance: Array, tested: Array) -> tuple[str, ...]:
    """Components whose `variance` (k,) is larger than `tested` (k,), that without untested products, by what counts."""
    grown = variance > MIN_SIGMA_GROWTH**2 * tested
    return tuple(name for name, is_grown in zip(components, grown, strict=True) if is_grown)


def describe_untested(untested: UntestedProducts, loads: Array, components: Sequence[str]) -> str:
    """A sentence on the products that matter at loads (k,), and the components that they make uncertain."""
    return (
        "the calibration has nonlinear terms, but its load series do not determine "
        f"{', nor '.join(untested.describe(loads))}: sigma of {', '.join(components)} at these combined loads "
        "includes their probable size. Calibrate with combined loads"
    )
