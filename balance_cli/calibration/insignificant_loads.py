"""Why a straight line does not tell the effect of a load: loads that go together, curvature, or too little load."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.block_zeros import subtract_block_means
from balance_cli.calibration.static_matrices import TrimRegression, TrimRows, regress, significance
from balance_cli.io.errors import UserError

Array = NDArray[np.float64]

MAX_LOAD_INFLATION = 100.0
"""Variance inflation of a load from which it counts as applied together with others: correlated to 99.5 %."""
MAX_UNEXPLAINED = 0.2
"""Share of the readings that a line leaves from which they contradict the loads: curvature of 20 % is no balance, and
where one load is not told, most channels follow the others."""
SHIFTED_SHARE = 1.0 / 3.0
"""Of that share, what it must fall to where readings are moved by a row: these then belong to the loads."""
MIN_SIGNIFICANCE = 25.0
"""Mean squared t of a component's coefficients (5 sigma) below which it counts as hardly loaded."""


def explain_insignificance(rows: TrimRows, components: tuple[str, ...], j: int) -> tuple[str, str]:
    """Explain why the coefficients of component j are not significant: fault and remedy.

    Both are empty where they are significant as soon as curvature has terms of its own: then the load is determined,
    and the straight line alone is a poor description of it.
    """
    partner, correlation, inflation = _most_correlated(rows, j)
    name = components[j]
    if inflation > MAX_LOAD_INFLATION:
        fault = f"`{name}` and `{components[partner]}` were always loaded together (correlation {correlation:.4f})"
        return fault, f"Apply `{name}` without `{components[partner]}`"
    curved = fit_with_curvature(rows, components)
    if curved is not None and significance(curved)[j] >= MIN_SIGNIFICANCE:
        return "", ""
    left = _unexplained_share(rows)
    if left > MAX_UNEXPLAINED:
        return _contradiction(rows, name, left)
    fault = f"`{name}` was hardly loaded, or no usable channel shows it"
    return fault, f"Apply `{name}` in steps, and check the channels that should show it"


def _contradiction(rows: TrimRows, name: str, left: float) -> tuple[str, str]:
    """Fault and remedy of readings that do not follow the loads, of which a fit leaves the share `left`."""
    largest, steps = float(np.max(np.abs(rows.loads))), np.any(np.diff(rows.loads, axis=0) != 0, axis=1)
    for shift, way in ((-1, "later"), (1, "earlier")) if largest > 0 and steps.any() else ():
        moved = replace(rows, channels=np.roll(rows.channels, shift, axis=0))
        if _unexplained_share(moved) < SHIFTED_SHARE * left:
            fault = f"the readings seem to stand one row {way} than their loads"
            return fault, "Put the readings of each load point into its row"
    fault = (
        f"the readings do not follow the loads, and the response to `{name}` is not told: a straight line leaves "
        f"{100.0 * left:.2g} % of what the readings change by, and no few load series explain it"
    )
    return fault, "Check signs, units and columns of the loads and the order of rows and channels in each load series"


def _unexplained_share(rows: TrimRows) -> float:
    """Share of the changes of the readings that a straight line leaves, rms, in the median channel."""
    x = subtract_block_means(np.hstack([rows.loads, rows.uncarried_loads]), rows.run)
    y = subtract_block_means(rows.channels, rows.run)
    left = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    power = np.maximum(np.sum(y**2, axis=0), np.finfo(float).tiny)
    return float(np.median(np.sqrt(np.sum(left**2, axis=0) / power)))


def fit_with_curvature(rows: TrimRows, components: Sequence[str]) -> TrimRegression | None:
    """Regression with the absolute value and square of each load as further columns; None where rows do not suffice.

    Its C0 is that of the loads alone beside these columns; their misfit no longer counts as error of C0.
    """
    size = np.max(np.abs(rows.loads), axis=0)
    x = rows.loads / np.where(size > 0, size, 1.0)
    for columns in (np.hstack([np.abs(x), x**2]), x**2):
        extra = _independent_columns(
            subtract_block_means(x, rows.run), subtract_block_means(columns, rows.run), columns
        )
        curved = replace(rows, uncarried_loads=np.hstack([rows.uncarried_loads, extra]))
        try:
            return regress(curved, tuple(components))
        except UserError:
            continue
    return None


def _independent_columns(basis: Array, centered: Array, columns: Array) -> Array:
    """Those columns (m, q) that, less their block means, are not combinations of the basis and of earlier ones."""
    independent, spanned = [], basis
    for place in range(columns.shape[1]):
        column = centered[:, place]
        left = column - spanned @ np.linalg.lstsq(spanned, column, rcond=None)[0]
        if np.linalg.norm(left) > MIN_COLUMN_SHARE * np.linalg.norm(columns[:, place]):
            independent.append(place)
            spanned = np.column_stack([spanned, column])
    return columns[:, independent]


MIN_COLUMN_SHARE = 1e-3
"""Share of the norm of a column that the others must leave, as for the terms of the calibration model."""


def _most_correlated(rows: TrimRows, j: int) -> tuple[int, float, float]:
    """The component whose load goes most with that of component j, their correlation, and the variance inflation."""
    x = subtract_block_means(rows.loads, rows.run)
    size = np.linalg.norm(x, axis=0)
    unit = x / np.where(size > 0, size, 1.0)
    gram = unit.T @ unit
    correlation = np.where(np.arange(len(gram)) == j, 0.0, gram[j])
    inflation = float(np.diag(np.linalg.pinv(gram, hermitian=True))[j]) if np.linalg.cond(gram) < 1e12 else np.inf
    partner = int(np.argmax(np.abs(correlation)))
    return partner, float(correlation[partner]), inflation if np.isfinite(inflation) else _exact_inflation(correlation)


def _exact_inflation(correlation: Array) -> float:
    """Variance inflation by the most correlated load alone, where the loads together are collinear."""
    left = 1.0 - float(np.max(np.abs(correlation))) ** 2
    return 1.0 / max(left, np.finfo(float).tiny)
