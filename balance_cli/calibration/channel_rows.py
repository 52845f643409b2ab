"""Rows of one channel, to which models of different terms are fitted and by which they are compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.block_zeros import BlockZeros
from balance_cli.calibration.cross_validation import parts_of_rows, prediction_errors
from balance_cli.calibration.least_squares import LeastSquares, solve_least_squares
from balance_cli.calibration.projection import Projection, RowGroups
from balance_cli.calibration.term_choice import TERM_SIGNIFICANCE_LEVEL

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class ChannelRows:
    """Rows of one channel: columns X (m, p), readings y (m,), zeros by block (m,), load series (m,), weight (m,).

    `known_errors`: prediction errors of models that were compared before.
    """

    X: Array
    y: Array
    block: Index
    load_series: Index
    linear_count: int
    weight: Array
    significance: float = TERM_SIGNIFICANCE_LEVEL
    known_errors: dict[tuple[int, ...], float] = field(default_factory=dict)

    @cached_property
    def zeros(self) -> BlockZeros:
        """The zeros of the blocks."""
        return BlockZeros.from_blocks(self.block, self.weight)

    @cached_property
    def parts(self) -> RowGroups | tuple[Index, ...]:
        """What is left out in turn."""
        return parts_of_rows(self.load_series)

    @cached_property
    def without_zeros(self) -> tuple[Array, Array]:
        """Columns (m, p) and readings (m,) in weighted rows, without the zeros."""
        A = self.zeros.subtract_means(np.column_stack([self.X, self.y]))
        return np.asarray(A[:, :-1], float), np.asarray(A[:, -1], float)

    def fit(self, selected: Sequence[int]) -> LeastSquares:
        """Fit of some columns."""
        return solve_least_squares(self.X[:, list(selected)], self.y[:, None], self.block, self.weight)

    def prediction_error(self, selected: Sequence[int]) -> float:
        """Weighted sum of squares of the errors of rows that are left out of the fit of some columns."""
        key = tuple(sorted(selected))
        if key not in self.known_errors:
            self.known_errors[key] = float(self.weight @ prediction_errors(self._project(key), self.parts) ** 2)
        return self.known_errors[key]

    def _project(self, selected: Sequence[int]) -> Projection:
        """What some columns leave, not refined as in a fit: models are compared by it, and differ by far more."""
        A, y = self.without_zeros
        Q = np.linalg.qr(A[:, list(selected)])[0]
        return Projection(
            residuals=((y - Q @ (Q.T @ y)) / self.zeros.root)[:, None],
            leverage=np.sum(Q**2, axis=1) + self.weight / self.zeros.total[self.zeros.place],
            weight=self.weight,
            block=self.zeros.place,
            Q=Q,
        )
