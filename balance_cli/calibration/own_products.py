"""Load series whose deviation a product of two loads explains that no other load series tells.

A product of a varied load with one that hangs changes the gain of a channel, as a fault does. Where the two loads were
applied together in one load series only, its readings do not tell which. Products of a few per cent are usual in
balances, faults of a single series are not; a larger deviation is taken for a fault.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.fit import CalibrationModelFit, CalibrationPoints
from balance_cli.calibration.term_support import MIN_APPLIED_LOAD
from balance_cli.calibration.terms import Term
from balance_cli.calibration.untested_products import MIN_NAMED_PRODUCT, gain_like_products

Mask = NDArray[np.bool_]

MAX_PRODUCT = 0.1
"""Product of two full loads over the largest linear response of the channel: interactions above it are a fault."""
MAX_ONE_SIDED = 0.01
"""The same for a term such as |F| that one load series alone shows: the directions of a balance of several pieces
differ by as much, which is a gain error of 2 % in one of them; a larger difference is taken for a fault."""
MOST_NAMED = 3
"""Products that a note names."""
MAX_RESIDUAL_RATIO = 3.0
"""Rms residual of a channel in the series over its standard deviation, up to which the product explains the series."""


def explaining_products(
    points: CalibrationPoints, fit: CalibrationModelFit, rows: Mask, channels: Iterable[str]
) -> dict[str, float]:
    """Products that only the rows (m,) of one load series tell and that explain these channels; empty where none does.

    Each with its largest coefficient over the linear response of the channel, by the name of the term.
    """
    return _explaining_terms(points, fit, rows, channels, _is_own)


def usual_one_sided_terms(
    points: CalibrationPoints, fit: CalibrationModelFit, rows: Mask, channels: Iterable[str]
) -> dict[str, float]:
    """Terms such as |F|, of a usual size, that explain these channels where one series alone has a direction."""
    sizes = _explaining_terms(points, fit, rows, channels, _is_one_sided)
    return sizes if max(sizes.values(), default=0.0) <= MAX_ONE_SIDED else {}


def one_sided_note(
    points: CalibrationPoints, fit: CalibrationModelFit, rows: Mask, channels: Iterable[str], series: str
) -> str:
    """That |F| or its like explain a suspect load series as well as a wrong gain, in words; empty where none does.

    A load that one series alone applies to a side may have another gain there, which is a term, or the channel had.
    """
    sizes = _explaining_terms(points, fit, rows, channels, _is_one_sided)
    if not sizes:
        return ""
    named = ", ".join(
        f"{term} ({100.0 * sizes[term]:.2g} % of the linear response)" for term in list(sizes)[:MOST_NAMED]
    )
    return (
        f"{series} was excluded, but {named} would explain it as well as a wrong gain: no other load series applies "
        "that load to that side. If it is sound, apply the load to that side in a further series"
    )


def _explaining_terms(
    points: CalibrationPoints,
    fit: CalibrationModelFit,
    rows: Mask,
    channels: Iterable[str],
    is_own: Callable[[CalibrationPoints, Mask, Term], bool],
) -> dict[str, float]:
    """The terms that `is_own` says only these rows (m,) tell, with their sizes, where they explain all the channels."""
    model, k = fit.model, len(points.components)
    sizes: dict[str, float] = {}
    terms = model.parsed_terms
    own = [place for place, term in enumerate(terms) if is_own(points, rows, term)]
    for name in channels:
        c = model.channel_names.index(name)
        largest = float(np.max(np.abs(model.coefficients[:k, c])))
        shares = {model.terms[place]: abs(model.coefficients[place, c]) / largest for place in own}
        shares = {term: float(size) for term, size in shares.items() if size > 0.0}
        usual = float(np.sqrt(np.nanmean(fit.residuals[~rows, c] ** 2)))
        is_fitted = float(np.sqrt(np.mean(fit.residuals[rows, c] ** 2))) <= MAX_RESIDUAL_RATIO * usual
        if not shares or not is_fitted or max(shares.values()) > MAX_PRODUCT:
            return {}
        sizes |= {term: max(size, sizes.get(term, 0.0)) for term, size in shares.items()}
    return sizes


def _is_own(points: CalibrationPoints, rows: Mask, term: Term) -> bool:
    """Whether the two loads of a term were applied together in these rows (m,), and in no others that are used."""
    if term.single_load:
        return False
    applied = np.abs(points.x) > MIN_APPLIED_LOAD
    together = applied[:, term.i] & applied[:, term.j] & (points.weight > 0)
    return bool(np.any(together & rows) and not np.any(together & ~rows))


def _is_one_sided(points: CalibrationPoints, rows: Mask, term: Term) -> bool:
    """Whether the load of a nonlinear term was applied to one of its sides in these rows (m,) alone."""
    if term.linear or not term.single_load:
        return False
    side = (points.x[:, [term.i]] * [1.0, -1.0] > MIN_APPLIED_LOAD) & (points.weight > 0)[:, None]
    return bool(np.any(side[rows].any(axis=0) & ~side[~rows].any(axis=0)))


def own_product_notes(points: CalibrationPoints, fit: CalibrationModelFit) -> Iterator[str]:
    """What the model takes for products of loads that one load series tells each, and what else they may be."""
    model, used = fit.model, np.asarray(np.isfinite(fit.residuals).all(axis=1))
    largest = np.max(np.abs(model.coefficients[: len(points.components)]), axis=0)
    sizes = {
        model.terms[place]: float(np.max(np.abs(model.coefficients[place]) / largest))
        for place in gain_like_products(model, points.x[used], points.load_series[used])
    }
    order = sorted((term for term, size in sizes.items() if size > MIN_NAMED_PRODUCT), key=lambda term: -sizes[term])
    if order:
        named = ", ".join(f"{term} ({100.0 * sizes[term]:.2g} % of the linear response)" for term in order[:MOST_NAMED])
        more = f" and {len(order) - MOST_NAMED} more" if len(order) > MOST_NAMED else ""
        yield (
            f"products that rest on one load series each: {named}{more}; a wrong gain in that series would look the "
            "same, and sigma of these loads together contains both. Apply them together in a further series"
        )
