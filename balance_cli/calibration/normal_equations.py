"""Normal equations of one channel, by which the search for terms compares models without refitting them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_VARIANCE_INFLATION = 1000.0
"""Variance inflation above which a term is not added: F, F|F| and F^3 in even steps have up to 336."""
RESIDUAL_POWER_FLOOR = 1e-14
"""Floor of the residual over the power of a channel: below it a residual is rounding, which no term should fit."""
LEAST_EIGENVALUE = 1e-10
"""Of the products of scaled terms: rounding leaves 1e-14, and 1e-6 is below that of 96 terms within the limit above."""


@dataclass(frozen=True)
class TermNormalEquations:
    """Normal equations of one channel, terms scaled, zeros eliminated: G (p, p), g (p,), y'y, rows less zeros."""

    G: Array
    g: Array
    yy: float
    rows_less_zeros: int

    def residual(self, selected: Sequence[int]) -> float:
        """Residual sum of squares of a model with these terms."""
        at = list(selected)
        try:
            left = float(self.yy - self.g[at] @ np.linalg.solve(self.G[np.ix_(at, at)], self.g[at]))
        except np.linalg.LinAlgError:  # terms that the rows do not tell apart explain nothing
            return self.yy
        return max(left, RESIDUAL_POWER_FLOOR * self.yy)

    def inflation(self, selected: Sequence[int]) -> Array:
        """Variance inflation factor of each of these terms, infinite where the rows do not tell them apart."""
        at = list(selected)
        products = self.G[np.ix_(at, at)]
        # The inverse of a matrix that is singular but for rounding is finite and wrong, and no error.
        if np.linalg.eigvalsh(products)[0] < LEAST_EIGENVALUE:
            return np.full(len(at), np.inf)
        return np.asarray(np.diag(np.linalg.inv(products)))

    def pair_residuals(self, selected: Sequence[int], pairs: NDArray[np.intp]) -> Array:
        """Residual sum of squares (n,) with each of these pairs (n, 2) of further terms beside the selected ones.

        That without the pair where the rows do not tell its terms apart.
        """
        at, (i, j) = list(selected), pairs.T
        along = np.linalg.solve(self.G[np.ix_(at, at)], np.column_stack([self.G[at], self.g[at]]))
        G, g = self.G - self.G[:, at] @ along[:, :-1], self.g - self.G[:, at] @ along[:, -1]
        a, b, c = G[i, i], G[j, j], G[i, j]
        determinant = a * b - c**2
        is_told = (np.minimum(a, b) > LEAST_EIGENVALUE) & (determinant > LEAST_EIGENVALUE * a * b)
        gain = (b * g[i] ** 2 + a * g[j] ** 2 - 2.0 * c * g[i] * g[j]) / np.where(is_told, determinant, 1.0)
        left = self.yy - self.g[at] @ along[:, -1] - np.where(is_told, gain, 0.0)
        return np.asarray(np.maximum(left, RESIDUAL_POWER_FLOOR * self.yy))

    def explained_squares(self, selected: Sequence[int]) -> tuple[Array, Array]:
        """Sum of squares (p,) that each further term would explain, and its variance inflation (p,)."""
        at = list(selected)
        along = np.linalg.solve(self.G[np.ix_(at, at)], np.column_stack([self.G[at], self.g[at]]))
        remaining_power = np.diag(self.G) - np.sum(self.G[at] * along[:, :-1], axis=0)
        remaining_product = self.g - self.G[:, at] @ along[:, -1]
        remaining_power[at] = 0.0
        is_identifiable = remaining_power > 1.0 / (10.0 * MAX_VARIANCE_INFLATION)
        divisor = np.where(is_identifiable, remaining_power, 1.0)
        inflation = np.where(is_identifiable, 1.0 / divisor, np.inf)
        return np.where(is_identifiable, remaining_product**2 / divisor, 0.0), inflation
