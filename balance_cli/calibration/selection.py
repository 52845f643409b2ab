"""Selection of the terms of each channel by a stepwise search for a hierarchical, well-conditioned model.

The loads themselves are in every model, so that each term of higher degree is accompanied by its loads. Terms are added
one at a time, the most significant first. After each addition every term is compared with all candidates in its place
(sequential replacement: Miller, Subset Selection in Regression, 2nd ed., 2002, chapter 3), and terms that are no longer
significant are removed. Where no single term is significant, pairs of correlated terms are tried: F|F| and F^3 of
opposite signs nearly cancel, and neither is significant without the other. The level is divided by the number of terms,
pairs and channels (Bonferroni), so that it is the probability of any spurious term in the balance. Finally a term is
removed unless it reduces the cross-validation error of the load series.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.block_zeros import BlockZeros
from balance_cli.calibration.channel_rows import ChannelRows
from balance_cli.calibration.few_rows import FEW_ROWS_P_VALUE, least_p_value_without_two_rows
from balance_cli.calibration.normal_equations import MAX_VARIANCE_INFLATION, TermNormalEquations
from balance_cli.calibration.term_choice import TERM_SIGNIFICANCE_LEVEL
from balance_cli.signals import distributions as stats

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MIN_DOF = 5
"""Degrees of freedom below which no term is added: the residual of so few rows is no measure of their noise."""
MAX_SELECTION_STEPS = 200
"""Upper bound on additions and on replacements: twice the 96 terms of six loads. A repeated model ends the search."""
ROWS_PER_FAMILY_COLUMN = 2
"""Rows less zeros for each column of a family that is taken as a whole."""
MIN_FAMILY_GAIN = 0.8
"""Squared prediction error of a family over that of the selected terms from which it is taken: 10 % in the rms."""
MIN_PAIR_CORRELATION = 0.5
"""Correlation, after loads and zeros are eliminated, above which two terms can hide each other."""


def select_terms(
    X: Array,
    Y: Array,
    block: Index,
    load_series: Index,
    linear_count: int,
    weight: Array | None = None,
    family: Sequence[int] = (),
    significance: float = TERM_SIGNIFICANCE_LEVEL,
    outputs: int | None = None,
) -> list[tuple[int, ...]]:
    """Select the columns of X (m, p) that each output of Y (m, c) has; the first `linear_count` are in every model.

    Each `block` (m,) has its own zero; cross-validation leaves out whole `load_series` (m,). `family`: columns that
    are taken all together where the load series are predicted far better with them than with the selected ones.
    `significance`: probability of a spurious term in any of the outputs, of which there are more `outputs` than those
    of Y where others are searched by themselves.
    """
    w = np.ones(len(X)) if weight is None else weight
    zeros = BlockZeros.from_blocks(block, w)
    Xc, Yc = (np.asarray(zeros.subtract_means(values), float) for values in (X, Y))
    size = np.linalg.norm(Xc, axis=0)
    Xs = Xc / np.where(size > 0, size, 1.0)
    G, g = Xs.T @ Xs, Xs.T @ Yc
    pairs = _correlated_pairs(G, linear_count)
    tests = max((X.shape[1] - linear_count + len(pairs)) * (outputs or Y.shape[1]), 1)
    rows_less_zeros = len(X) - len(np.unique(block))
    channel_terms = []
    for c in range(Y.shape[1]):
        normal = TermNormalEquations(G, g[:, c], float(Yc[:, c] @ Yc[:, c]), rows_less_zeros)
        selected = _search_stepwise(normal, linear_count, significance / tests, pairs)
        rows = ChannelRows(X, Y[:, c], block, load_series, linear_count, w, significance)
        selected = _drop_terms_of_few_rows(_limit_inflation(normal, selected, linear_count), rows)
        channel_terms.append(_best_predictor(_cross_validate(selected, rows), rows, normal, family))
    return channel_terms


def _limit_inflation(normal: TermNormalEquations, selected: list[int], linear_count: int) -> list[int]:
    """Remove terms, those of the largest variance inflation first, until that of no column exceeds its limit."""
    while len(selected) > linear_count:
        inflation = normal.inflation(selected)
        if np.max(inflation) <= MAX_VARIANCE_INFLATION:
            break
        worst = linear_count + int(np.argmax(inflation[linear_count:]))
        selected = [term for place, term in enumerate(selected) if place != worst]
    return selected


def _drop_terms_of_few_rows(selected: list[int], rows: ChannelRows) -> list[int]:
    """Remove the terms that are not significant without some two rows, the least significant first."""
    while len(selected) > rows.linear_count:
        fit = rows.fit(selected)
        p = [least_p_value_without_two_rows(fit, place) for place in range(rows.linear_count, len(selected))]
        worst = int(np.argmax(p))
        if p[worst] <= FEW_ROWS_P_VALUE:
            break
        selected = [term for place, term in enumerate(selected) if place != rows.linear_count + worst]
    return selected


def _best_predictor(
    selected: tuple[int, ...], rows: ChannelRows, normal: TermNormalEquations, family: Sequence[int]
) -> tuple[int, ...]:
    """The selected columns, unless the loads alone or the whole family predict rows that are left out better.

    Many small terms can be significant together and none by itself; only a large gain outweighs that they are many.
    """
    linear = tuple(range(rows.linear_count))
    error = rows.prediction_error(selected)
    if selected != linear:
        without = rows.prediction_error(linear)
        selected, error = (linear, without) if without < error else (selected, error)
    complete = tuple(sorted({*linear, *family}))
    if not family or _family_p_value(normal, selected, complete, linear) > rows.significance:
        return selected
    if normal.rows_less_zeros < ROWS_PER_FAMILY_COLUMN * len(complete):
        return selected
    if np.max(normal.inflation(complete)) > MAX_VARIANCE_INFLATION:
        return selected
    return complete if rows.prediction_error(complete) < MIN_FAMILY_GAIN * error else selected


def _family_p_value(
    normal: TermNormalEquations, selected: tuple[int, ...], complete: tuple[int, ...], linear: tuple[int, ...]
) -> float:
    """p-value of what a whole family explains beyond the selected columns, or the linear ones where it lacks some.

    Load series that are left out are few: they can be predicted better by chance.
    """
    within = selected if set(selected) < set(complete) else linear
    terms, dof = len(complete) - len(within), normal.rows_less_zeros - len(complete)
    if terms == 0 or dof < MIN_DOF:
        return 1.0
    residual = normal.residual(complete)
    return _p_value(normal.residual(within) - residual, residual, dof, terms)


def _correlated_pairs(G: Array, linear_count: int) -> list[tuple[int, int]]:
    """Pairs of terms that are correlated after elimination of the loads, from their scaled products G (p, p)."""
    first = slice(0, linear_count)
    left = G - G[:, first] @ np.linalg.solve(G[first, first], G[first])
    size = np.sqrt(np.maximum(np.diag(left), np.finfo(float).tiny))
    is_correlated = np.triu(np.abs(left) > MIN_PAIR_CORRELATION * size[:, None] * size, 1)
    is_correlated[first] = False
    return [(int(i), int(j)) for i, j in np.argwhere(is_correlated)]


def _search_stepwise(
    normal: TermNormalEquations, linear_count: int, level: float, pairs: Sequence[tuple[int, int]]
) -> list[int]:
    """Add, replace and remove terms until the model no longer changes."""
    selected = list(range(linear_count))
    visited = {tuple(selected)}
    for _ in range(MAX_SELECTION_STEPS):
        if normal.rows_less_zeros - len(selected) < MIN_DOF:
            break
        new, p = _best_addition(normal, selected)
        if p > level:
            new, p = _best_pair(normal, selected, pairs)
        if p > level:
            break
        selected = _replace_sequentially(normal, [*selected, *new], linear_count)
        selected = _eliminate_backward(normal, selected, linear_count, level)
        if tuple(sorted(selected)) in visited:
            break
        visited.add(tuple(sorted(selected)))
    return sorted(selected)


def _best_addition(normal: TermNormalEquations, selected: Sequence[int]) -> tuple[tuple[int, ...], float]:
    """The term that explains most, with its p-value; no term and 1 where none may be added."""
    explained_squares, inflation = normal.explained_squares(selected)
    explained_squares = np.where(inflation <= MAX_VARIANCE_INFLATION, explained_squares, 0.0)
    best = int(np.argmax(explained_squares))
    if explained_squares[best] <= 0.0:
        return (), 1.0
    return (best,), _p_value(
        explained_squares[best], normal.residual([*selected, best]), normal.rows_less_zeros - len(selected) - 1
    )


def _best_pair(
    normal: TermNormalEquations, selected: Sequence[int], pairs: Sequence[tuple[int, int]]
) -> tuple[tuple[int, ...], float]:
    """The pair of terms that explains most, with its p-value; no terms and 1 where none may be added."""
    at = list(selected)
    known = set(at)
    open_pairs = [pair for pair in pairs if not known & set(pair)]
    if not open_pairs:
        return (), 1.0
    residuals = normal.pair_residuals(at, np.array(open_pairs, np.intp))
    place = int(np.argmin(residuals))
    best, left = open_pairs[place], float(residuals[place])
    if np.max(normal.inflation([*at, *best])[-2:]) > MAX_VARIANCE_INFLATION:
        return (), 1.0
    return best, _p_value(normal.residual(at) - left, left, normal.rows_less_zeros - len(at) - 2, 2)


def _p_value(gain: float, residual: float, dof: int, terms: int = 1) -> float:
    mean = max(residual / max(dof, 1), np.finfo(float).tiny)
    return float(stats.f.sf(gain / terms / mean, terms, max(dof, 1)))


def _replace_sequentially(normal: TermNormalEquations, selected: list[int], linear_count: int) -> list[int]:
    """Replace terms by better ones, one at a time, until no replacement reduces the residual."""
    for _ in range(MAX_SELECTION_STEPS):
        residual = normal.residual(selected)
        best, swap = residual * (1.0 - 1e-9), None
        for k in selected:
            if k < linear_count:
                continue
            others = [term for term in selected if term != k]
            explained_squares, inflation = normal.explained_squares(others)
            explained_squares = np.where(inflation <= MAX_VARIANCE_INFLATION, explained_squares, 0.0)
            new = int(np.argmax(explained_squares))
            left = normal.residual(others) - explained_squares[new]
            if new != k and left < best:
                best, swap = left, [*others, new]
        if swap is None:
            return selected
        selected = swap
    return selected


def _eliminate_backward(normal: TermNormalEquations, selected: list[int], linear_count: int, level: float) -> list[int]:
    """Remove the terms that are not significant, the least significant first."""
    while True:
        residual, dof = normal.residual(selected), normal.rows_less_zeros - len(selected)
        loss = {
            k: normal.residual([term for term in selected if term != k]) - residual
            for k in selected
            if k >= linear_count
        }
        least = min(loss, key=lambda k: loss[k], default=None)
        if least is None or _p_value(loss[least], residual, dof) <= level:
            return selected
        selected = [term for term in selected if term != least]


def _cross_validate(selected: Sequence[int], rows: ChannelRows) -> tuple[int, ...]:
    """Remove the terms that do not help to predict rows that are left out, the worst first."""
    selected = list(selected)
    while len(selected) > rows.linear_count:
        error = rows.prediction_error(selected)
        error_without = {
            k: rows.prediction_error([term for term in selected if term != k]) for k in selected[rows.linear_count :]
        }
        worst = min(error_without, key=lambda k: error_without[k])
        if error_without[worst] >= error:
            break
        selected = [term for term in selected if term != worst]
    return tuple(selected)
