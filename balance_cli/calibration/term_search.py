"""Search for the terms of all channels, with the weights that rows have by the noise of the applied loads.

The error of an applied load acts in the rows of that load alone, where the terms of that load act, too: with one noise
for all rows, 26 of 180 calibrations of linear balances had a term at a level of 1 %; with weights they are two.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.least_squares import solve_least_squares
from balance_cli.calibration.noise import row_variance
from balance_cli.calibration.selection import select_terms
from balance_cli.calibration.term_choice import TERM_SIGNIFICANCE_LEVEL

Array = NDArray[np.float64]
Index = NDArray[np.intp]


def search_terms(
    X: Array,
    Y: Array,
    x: Array,
    load_series: Index,
    weight: Array,
    family: Sequence[int] = (),
    significance: float = TERM_SIGNIFICANCE_LEVEL,
) -> list[tuple[int, ...]]:
    """Select the columns of X (m, p), of which the loads x (m, k) are the first, for each output of Y (m, c).

    `family` and `significance` are those of `select_terms`. Where some output has a term, that one is selected again
    with weights from the noise that this model leaves: a real term does not count as noise.
    """
    k = x.shape[1]
    terms_by_output = select_terms(X, Y, load_series, load_series, k, weight, family, significance)
    for c, selected in enumerate(terms_by_output):
        if len(selected) == k:
            continue
        y = Y[:, [c]]
        residuals = solve_least_squares(X[:, list(selected)], y, load_series, weight).residuals[:, 0]
        by_noise = weight / row_variance(np.sqrt(weight) * residuals, x)
        (terms_by_output[c],) = select_terms(
            X, y, load_series, load_series, k, by_noise, family, significance, outputs=Y.shape[1]
        )
    return terms_by_output
