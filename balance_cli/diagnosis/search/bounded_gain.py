"""The largest gain of a quadratic form in parameters that may be bounded on one side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from balance_cli.model.effects import EffectParameter

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def one_sided_bounds(items: Sequence[EffectParameter]) -> tuple[Mask, Mask]:
    """Return which parameters (q,) cannot be below their null, and which cannot be above it."""
    lower = np.array([item.fitted_bounds[0] >= item.fitted_null for item in items], bool)
    upper = np.array([item.fitted_bounds[1] <= item.fitted_null for item in items], bool)
    return lower, upper


class BestGain(NamedTuple):
    """The largest gain, the number of directions that the data inform, and the step (q,) that attains it."""

    gain: float
    directions: int
    step: Array


def best_gain(s: Array, V: Array, lower: Mask, upper: Mask, min_share: float) -> BestGain:
    """Return the maximum of 2 s'd - d'V d with d >= 0 where `lower` and d <= 0 where `upper`.

    With V = L'L it is the non-negative least-squares problem |L d - L'^-1 s|^2, in which an unbounded parameter has one
    column for each sign. Eigenvalues of the scaled V below `min_share` of the largest are dropped.
    """
    if len(s) == 1:
        return _best_gain_of_one(float(s[0]), float(V[0, 0]), bool(lower[0]), bool(upper[0]))
    from scipy.optimize import nnls

    step = np.zeros(len(s))
    informed = np.diag(V) > 0
    if not informed.any():
        return BestGain(0.0, 0, step)
    scale = np.where(informed, 1.0 / np.sqrt(np.where(informed, np.diag(V), 1.0)), 0.0)
    values, vectors = np.linalg.eigh(V * np.outer(scale, scale))
    significant = values > min_share * values.max()
    directions = int(significant.sum())
    root = np.sqrt(values[significant])[:, None] * vectors[:, significant].T
    target = (vectors[:, significant].T @ (s * scale)) / np.sqrt(values[significant])
    up, down = np.flatnonzero(informed & ~upper), np.flatnonzero(informed & ~lower)
    columns = np.concatenate([root[:, up], -root[:, down]], axis=1)
    if not columns.shape[1]:
        return BestGain(0.0, directions, step)
    weights, residual = nnls(columns, target)
    step[up] += weights[: len(up)]
    step[down] -= weights[len(up) :]
    return BestGain(float(max(target @ target - residual**2, 0.0)), directions, step * scale)


def _best_gain_of_one(s: float, V: float, lower: bool, upper: bool) -> BestGain:
    """The same of a single parameter, as most candidates have: a rig with 24 channels has six hundred crosstalks."""
    if V <= 0:
        return BestGain(0.0, 0, np.zeros(1))
    is_barred = (s < 0 and lower) or (s > 0 and upper)
    return BestGain(0.0, 1, np.zeros(1)) if is_barred else BestGain(s * s / V, 1, np.array([s / V]))
