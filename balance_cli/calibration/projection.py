"""Rows projected on the terms of a regression: what is left of them, and how each is predicted by the others.

With Q (m, p) an orthonormal basis of the terms within the blocks, in weighted rows:

    PRESS            e_i / (1 - h_i),  h_i from the diagonal of QQ' and the share of row i in its zero
                     (Allen, Technometrics 16 (1974) 125)
    left-out blocks  (1 - Q_B Q_B')^-1 e_B: a block that was left out still has its own zero
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]

PRESS_LEVERAGE_FLOOR = 1e-8
"""Floor of 1 - leverage, so that the PRESS residual of a row that alone determines a coefficient is finite."""
MIN_KNOWN_SHARE = 1e-4
"""Share of the information on each term that the other groups must hold for a group to be predicted from them."""


@dataclass(frozen=True)
class RowGroups:
    """Groups of m rows, of which each in turn is left out.

    `classes`: groups of similar size together, since these are solved together: rows (g, r) of g groups, padded with
    the first row of all, and which of them are members. Those of one class differ in size by less than a factor of two.
    """

    classes: tuple[tuple[Index, NDArray[np.bool_]], ...]

    @classmethod
    def from_labels(cls, group: Index) -> RowGroups:
        """Return the groups that `group` (m,) names."""
        place = np.unique(group, return_inverse=True)[1]
        order, count = np.argsort(place, kind="stable"), np.bincount(place)
        first, size_class = np.cumsum(count) - count, np.frexp(count)[1]
        classes = []
        for number in np.unique(size_class):
            members = np.flatnonzero(size_class == number)
            offset = np.arange(count[members].max())
            is_row = offset < count[members][:, None]
            classes.append((order[np.where(is_row, first[members][:, None] + offset, 0)], is_row))
        return cls(tuple(classes))


@dataclass(frozen=True)
class Projection:
    """What a regression leaves of m rows: `residuals` (m, c), `Q` (m, p), `leverage`, `weight`, `block` (m,)."""

    residuals: Array
    leverage: Array
    weight: Array
    block: Index
    Q: Array

    @property
    def press_residuals(self) -> Array:
        """Error (m, c) of the prediction of each row by all others."""
        return np.asarray(self.residuals / np.maximum(1.0 - self.leverage, PRESS_LEVERAGE_FLOOR)[:, None])

    def errors_without(self, groups: RowGroups) -> Array:
        """Errors (m, c) of the rows of each group, predicted from the other groups and the zero of each block.

        The groups consist of whole blocks. NaN where the other groups do not determine a term.
        """
        errors = np.full(self.residuals.shape, np.nan)
        root = np.sqrt(self.weight)[:, None]
        scaled = root * self.residuals
        for rows, is_row in groups.classes:
            # The smaller of two equivalent systems: (1 - Q Q')^-1 = 1 + Q (1 - Q'Q)^-1 Q'.
            Q = np.where(is_row[:, :, None], self.Q[rows], 0.0)
            remainders = np.eye(Q.shape[2]) - Q.swapaxes(1, 2) @ Q
            known = np.linalg.eigvalsh(remainders)[:, 0] > MIN_KNOWN_SHARE
            Q, at, inside = Q[known], rows[known], is_row[known]
            predicted = scaled[at] + Q @ np.linalg.solve(remainders[known], Q.swapaxes(1, 2) @ scaled[at])
            errors[at[inside]] = (predicted / root[at])[inside]
        return errors

    def cross_validation_errors(self, group: Index) -> Array:
        """Errors (m, c) as of `errors_without`, of the groups that `group` (m,) names."""
        return self.errors_without(RowGroups.from_labels(group))
