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

from balance_cli.calibration.least_squares import regression, without_zeros

Array = NDArray[np.float64]
Index = NDArray[np.intp]

LEVEL = 0.01
"""Probability of a spurious term anywhere in the balance."""
LARGEST_INFLATION = 1000.0
"""Variance inflation beyond which a term is not taken in: F, F|F| and F^3 in even steps have up to 336."""
# Of a channel's power: no reading is better than that, and a computed one has no curvature from rounding.
LEAST_LEFT = 1e-14
MOST_ROUNDS = 200
# Correlation, loads and zeros taken out, beyond which two terms can hide each other.
ALIKE = 0.5


@dataclass(frozen=True)
class _Normal:
    """Normal equations of one channel, terms scaled, zeros taken out: G (p, p), g (p,), y'y, rows less zeros."""

    G: Array
    g: Array
    yy: float
    free: int

    def residual(self, chosen: Sequence[int]) -> float:
        """Sum of squares that these terms leave."""
        at = list(chosen)
        left = float(self.yy - self.g[at] @ np.linalg.solve(self.G[np.ix_(at, at)], self.g[at]))
        return max(left, LEAST_LEFT * self.yy)

    def inflation(self, chosen: Sequence[int]) -> Array:
        """Variance inflation of each of these terms."""
        at = list(chosen)
        return np.asarray(np.diag(np.linalg.inv(self.G[np.ix_(at, at)])))

    def gains(self, chosen: Sequence[int]) -> tuple[Array, Array]:
        """Of every term beside the chosen ones: the squares it would explain (p,), and its variance inflation (p,)."""
        at = list(chosen)
        along = np.linalg.solve(self.G[np.ix_(at, at)], np.column_stack([self.G[at], self.g[at]]))
        left = np.diag(self.G) - np.sum(self.G[at] * along[:, :-1], axis=0)
        slope = self.g - self.G[:, at] @ along[:, -1]
        left[at] = 0.0
        told = left > 1.0 / (10.0 * LARGEST_INFLATION)
        inflation = np.where(told, 1.0 / np.where(told, left, 1.0), np.inf)
        return np.where(told, slope**2 / np.where(told, left, 1.0), 0.0), inflation


def chosen_terms(
    X: Array, Y: Array, block: Index, sequence: Index, straight: int, weight: Array | None = None
) -> list[tuple[int, ...]]:
    """Of columns X (m, p), the first `straight` of which are in every model, those that each output of Y (m, c) has.

    `block` (m,) has a zero of its own; `sequence` (m,) is what cross-validation leaves out, whole.
    """
    w = np.ones(len(X)) if weight is None else weight
    Xc, Yc = (without_zeros(values, block, w) for values in (X, Y))
    size = np.linalg.norm(Xc, axis=0)
    Xs = Xc / np.where(size > 0, size, 1.0)
    G, g = Xs.T @ Xs, Xs.T @ Yc
    pairs = _alike(G, straight)
    tests = max((X.shape[1] - straight + len(pairs)) * Y.shape[1], 1)
    free = len(X) - len(np.unique(block))
    found = []
    for c in range(Y.shape[1]):
        normal = _Normal(G, g[:, c], float(Yc[:, c] @ Yc[:, c]), free)
        chosen = _searched(normal, straight, LEVEL / tests, pairs)
        found.append(_validated(chosen, X, Y[:, c], block, sequence, straight, w))
    return found


def _alike(G: Array, straight: int) -> list[tuple[int, int]]:
    """Pairs of terms that are alike beside the loads themselves, from their scaled products G (p, p)."""
    first = slice(0, straight)
    left = G - G[:, first] @ np.linalg.solve(G[first, first], G[first])
    size = np.sqrt(np.maximum(np.diag(left), np.finfo(float).tiny))
    far = np.triu(np.abs(left) > ALIKE * size[:, None] * size, 1)
    far[first] = False
    return [(int(i), int(j)) for i, j in np.argwhere(far)]


def _searched(normal: _Normal, straight: int, level: float, pairs: Sequence[tuple[int, int]]) -> list[int]:
    """Terms in, replaced and out, until nothing changes."""
    chosen = list(range(straight))
    seen = {tuple(chosen)}
    for _ in range(MOST_ROUNDS):
        new, p = _best_addition(normal, chosen)
        if p > level:
            new, p = _best_pair(normal, chosen, pairs)
        if p > level:
            break
        chosen = _replaced(normal, [*chosen, *new], straight)
        chosen = _pruned(normal, chosen, straight, level)
        if tuple(sorted(chosen)) in seen:
            break
        seen.add(tuple(sorted(chosen)))
    return sorted(chosen)


def _best_addition(normal: _Normal, chosen: Sequence[int]) -> tuple[tuple[int, ...], float]:
    """The term that explains most, and the probability that chance does; none, and 1, where none may come in."""
    gains, inflation = normal.gains(chosen)
    gains = np.where(inflation <= LARGEST_INFLATION, gains, 0.0)
    best = int(np.argmax(gains))
    if gains[best] <= 0.0:
        return (), 1.0
    return (best,), _probability(gains[best], normal.residual([*chosen, best]), normal.free - len(chosen) - 1)


def _best_pair(
    normal: _Normal, chosen: Sequence[int], pairs: Sequence[tuple[int, int]]
) -> tuple[tuple[int, ...], float]:
    """The pair that explains most, and the probability that chance does."""
    at = list(chosen)
    known = set(at)
    left = {pair: normal.residual([*at, *pair]) for pair in pairs if not known & set(pair)}
    best = min(left, key=lambda pair: left[pair], default=None)
    if best is None or np.max(normal.inflation([*at, *best])[-2:]) > LARGEST_INFLATION:
        return (), 1.0
    gain, dof = normal.residual(at) - left[best], normal.free - len(at) - 2
    return best, _probability(gain, left[best], dof, 2)


def _probability(gain: float, residual: float, dof: int, terms: int = 1) -> float:
    mean = max(residual / max(dof, 1), np.finfo(float).tiny)
    return float(stats.f.sf(gain / terms / mean, terms, max(dof, 1)))


def _replaced(normal: _Normal, chosen: list[int], straight: int) -> list[int]:
    """Every term once held against all others in its place, until none is better."""
    for _ in range(MOST_ROUNDS):
        residual = normal.residual(chosen)
        best, swap = residual * (1.0 - 1e-9), None
        for k in chosen:
            if k < straight:
                continue
            others = [one for one in chosen if one != k]
            gains, inflation = normal.gains(others)
            gains = np.where(inflation <= LARGEST_INFLATION, gains, 0.0)
            new = int(np.argmax(gains))
            left = normal.residual(others) - gains[new]
            if new != k and left < best:
                best, swap = left, [*others, new]
        if swap is None:
            return chosen
        chosen = swap
    return chosen


def _pruned(normal: _Normal, chosen: list[int], straight: int, level: float) -> list[int]:
    """Without the terms that are not significant, the least first."""
    while True:
        residual, dof = normal.residual(chosen), normal.free - len(chosen)
        lost = {k: normal.residual([one for one in chosen if one != k]) - residual for k in chosen if k >= straight}
        least = min(lost, key=lambda k: lost[k], default=None)
        if least is None or _probability(lost[least], residual, dof) <= level:
            return chosen
        chosen = [one for one in chosen if one != least]


def _validated(
    chosen: list[int], X: Array, y: Array, block: Index, sequence: Index, straight: int, weight: Array
) -> tuple[int, ...]:
    """Without the terms that do not help to predict sequences that took no part, the worst first."""
    while len(chosen) > straight:
        error = _left_out_error(chosen, X, y, block, sequence, weight)
        less = {
            k: _left_out_error([one for one in chosen if one != k], X, y, block, sequence, weight)
            for k in chosen
            if k >= straight
        }
        worst = min(less, key=lambda k: less[k])
        # A term that one sequence alone determines cannot be told without it, and stays.
        if not (np.isfinite(less[worst]) and np.isfinite(error)) or less[worst] >= error:
            break
        chosen = [one for one in chosen if one != worst]
    return tuple(chosen)


def _left_out_error(chosen: Sequence[int], X: Array, y: Array, block: Index, sequence: Index, weight: Array) -> float:
    errors = regression(X[:, list(chosen)], y[:, None], block, weight).left_out(sequence)[:, 0]
    return float(weight @ errors**2)
