"""Which terms a channel has: a search that ends in a hierarchical, well-conditioned model.

The loads themselves are in every model; a term of higher degree is in only with the loads that it is made of. Terms
come in one by one, the most significant first; after each, every term is once held against all others in its place
(sequential replacement: Miller, Subset Selection in Regression, 2nd ed., 2002, chapter 3), and what is no longer
significant goes. Where no single term is significant, two that are alike may be together: F|F| and F^3 of opposite
signs nearly cancel, and neither shows without the other. The level is shared out over all terms, pairs and channels
(Bonferroni), so that it is the probability of one spurious term in the whole balance. In the end a term must lower the
error of loading sequences that took no part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from balance_cli.calibration.least_squares import regression, subtract_block_means

Array = NDArray[np.float64]
Index = NDArray[np.intp]

TERM_SIGNIFICANCE_LEVEL = 0.01
"""Probability of a spurious term anywhere in the balance."""
MAX_VARIANCE_INFLATION = 1000.0
"""Variance inflation beyond which a term is not taken in: F, F|F| and F^3 in even steps have up to 336."""
# Of a channel's power: no reading is better than that, and a computed one has no curvature from rounding.
RESIDUAL_POWER_FLOOR = 1e-14
MAX_SELECTION_STEPS = 200
# Correlation, loads and zeros taken out, beyond which two terms can hide each other.
MIN_PAIR_CORRELATION = 0.5


@dataclass(frozen=True)
class _TermNormalEquations:
    """Normal equations of one channel, terms scaled, zeros taken out: G (p, p), g (p,), y'y, rows less zeros."""

    G: Array
    g: Array
    yy: float
    rows_less_zeros: int

    def residual(self, selected: Sequence[int]) -> float:
        """Sum of squares that these terms leave."""
        at = list(selected)
        left = float(self.yy - self.g[at] @ np.linalg.solve(self.G[np.ix_(at, at)], self.g[at]))
        return max(left, RESIDUAL_POWER_FLOOR * self.yy)

    def inflation(self, selected: Sequence[int]) -> Array:
        """Variance inflation of each of these terms."""
        at = list(selected)
        return np.asarray(np.diag(np.linalg.inv(self.G[np.ix_(at, at)])))

    def explained_squares(self, selected: Sequence[int]) -> tuple[Array, Array]:
        """Of every term beside the chosen ones: the squares it would explain (p,), and its variance inflation (p,)."""
        at = list(selected)
        along = np.linalg.solve(self.G[np.ix_(at, at)], np.column_stack([self.G[at], self.g[at]]))
        left = np.diag(self.G) - np.sum(self.G[at] * along[:, :-1], axis=0)
        slope = self.g - self.G[:, at] @ along[:, -1]
        left[at] = 0.0
        is_identifiable = left > 1.0 / (10.0 * MAX_VARIANCE_INFLATION)
        inflation = np.where(is_identifiable, 1.0 / np.where(is_identifiable, left, 1.0), np.inf)
        return np.where(is_identifiable, slope**2 / np.where(is_identifiable, left, 1.0), 0.0), inflation


def select_terms(
    X: Array, Y: Array, block: Index, sequence: Index, linear_count: int, weight: Array | None = None
) -> list[tuple[int, ...]]:
    """Of columns X (m, p), the first `linear_count` of which are in every model, those that each output of Y (m, c)
    has.

    `block` (m,) has a zero of its own; `sequence` (m,) is what cross-validation leaves out, whole.
    """
    w = np.ones(len(X)) if weight is None else weight
    Xc, Yc = (subtract_block_means(values, block, w) for values in (X, Y))
    size = np.linalg.norm(Xc, axis=0)
    Xs = Xc / np.where(size > 0, size, 1.0)
    G, g = Xs.T @ Xs, Xs.T @ Yc
    pairs = _correlated_pairs(G, linear_count)
    tests = max((X.shape[1] - linear_count + len(pairs)) * Y.shape[1], 1)
    rows_less_zeros = len(X) - len(np.unique(block))
    found = []
    for c in range(Y.shape[1]):
        normal = _TermNormalEquations(G, g[:, c], float(Yc[:, c] @ Yc[:, c]), rows_less_zeros)
        selected = _search_stepwise(normal, linear_count, TERM_SIGNIFICANCE_LEVEL / tests, pairs)
        found.append(_cross_validate(selected, X, Y[:, c], block, sequence, linear_count, w))
    return found


def _correlated_pairs(G: Array, linear_count: int) -> list[tuple[int, int]]:
    """Pairs of terms that are alike beside the loads themselves, from their scaled products G (p, p)."""
    first = slice(0, linear_count)
    left = G - G[:, first] @ np.linalg.solve(G[first, first], G[first])
    size = np.sqrt(np.maximum(np.diag(left), np.finfo(float).tiny))
    far = np.triu(np.abs(left) > MIN_PAIR_CORRELATION * size[:, None] * size, 1)
    far[first] = False
    return [(int(i), int(j)) for i, j in np.argwhere(far)]


def _search_stepwise(
    normal: _TermNormalEquations, linear_count: int, level: float, pairs: Sequence[tuple[int, int]]
) -> list[int]:
    """Terms in, replaced and out, until nothing changes."""
    selected = list(range(linear_count))
    seen = {tuple(selected)}
    for _ in range(MAX_SELECTION_STEPS):
        new, p = _best_addition(normal, selected)
        if p > level:
            new, p = _best_pair(normal, selected, pairs)
        if p > level:
            break
        selected = _replace_sequentially(normal, [*selected, *new], linear_count)
        selected = _eliminate_backward(normal, selected, linear_count, level)
        if tuple(sorted(selected)) in seen:
            break
        seen.add(tuple(sorted(selected)))
    return sorted(selected)


def _best_addition(normal: _TermNormalEquations, selected: Sequence[int]) -> tuple[tuple[int, ...], float]:
    """The term that explains most, and the probability that chance does; none, and 1, where none may come in."""
    explained_squares, inflation = normal.explained_squares(selected)
    explained_squares = np.where(inflation <= MAX_VARIANCE_INFLATION, explained_squares, 0.0)
    best = int(np.argmax(explained_squares))
    if explained_squares[best] <= 0.0:
        return (), 1.0
    return (best,), _p_value(
        explained_squares[best], normal.residual([*selected, best]), normal.rows_less_zeros - len(selected) - 1
    )


def _best_pair(
    normal: _TermNormalEquations, selected: Sequence[int], pairs: Sequence[tuple[int, int]]
) -> tuple[tuple[int, ...], float]:
    """The pair that explains most, and the probability that chance does."""
    at = list(selected)
    known = set(at)
    left = {pair: normal.residual([*at, *pair]) for pair in pairs if not known & set(pair)}
    best = min(left, key=lambda pair: left[pair], default=None)
    if best is None or np.max(normal.inflation([*at, *best])[-2:]) > MAX_VARIANCE_INFLATION:
        return (), 1.0
    gain, dof = normal.residual(at) - left[best], normal.rows_less_zeros - len(at) - 2
    return best, _p_value(gain, left[best], dof, 2)


def _p_value(gain: float, residual: float, dof: int, terms: int = 1) -> float:
    mean = max(residual / max(dof, 1), np.finfo(float).tiny)
    return float(stats.f.sf(gain / terms / mean, terms, max(dof, 1)))


def _replace_sequentially(normal: _TermNormalEquations, selected: list[int], linear_count: int) -> list[int]:
    """Every term once held against all others in its place, until none is better."""
    for _ in range(MAX_SELECTION_STEPS):
        residual = normal.residual(selected)
        best, swap = residual * (1.0 - 1e-9), None
        for k in selected:
            if k < linear_count:
                continue
            others = [one for one in selected if one != k]
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


def _eliminate_backward(
    normal: _TermNormalEquations, selected: list[int], linear_count: int, level: float
) -> list[int]:
    """Without the terms that are not significant, the least first."""
    while True:
        residual, dof = normal.residual(selected), normal.rows_less_zeros - len(selected)
        lost = {
            k: normal.residual([one for one in selected if one != k]) - residual for k in selected if k >= linear_count
        }
        least = min(lost, key=lambda k: lost[k], default=None)
        if least is None or _p_value(lost[least], residual, dof) <= level:
            return selected
        selected = [one for one in selected if one != least]


def _cross_validate(
    selected: list[int], X: Array, y: Array, block: Index, sequence: Index, linear_count: int, weight: Array
) -> tuple[int, ...]:
    """Without the terms that do not help to predict sequences that took no part, the worst first."""
    while len(selected) > linear_count:
        error = _cross_validation_error(selected, X, y, block, sequence, weight)
        less = {
            k: _cross_validation_error([one for one in selected if one != k], X, y, block, sequence, weight)
            for k in selected
            if k >= linear_count
        }
        worst = min(less, key=lambda k: less[k])
        # A term that one sequence alone determines cannot be told without it, and stays.
        if not (np.isfinite(less[worst]) and np.isfinite(error)) or less[worst] >= error:
            break
        selected = [one for one in selected if one != worst]
    return tuple(selected)


def _cross_validation_error(
    selected: Sequence[int], X: Array, y: Array, block: Index, sequence: Index, weight: Array
) -> float:
    errors = regression(X[:, list(selected)], y[:, None], block, weight).left_out(sequence)[:, 0]
    return float(weight @ errors**2)
