"""The test of ranks for a drift (Mann, Econometrica 13, 1945, 245; Kendall), with the slope of Theil and Sen.

Neither the distribution of the values nor the form of the drift matters. The rate is the median of the slopes of all
pairs (Sen, J. Am. Stat. Assoc. 63, 1968, 1379).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

Array = NDArray[np.float64]

FEWEST_DRIFT_RUNS = 8
"""Runs in sequence from which a drift of ranks can have a p-value far below the significance."""
MOST_PAIRS_RUNS = 2000
"""Runs of which all pairs are compared; of more, every k-th is taken."""


@dataclass(frozen=True)
class RankTrend:
    """Course of values over their place.

    `first` and `last` are medians over the first and the last third; `tau` is Kendall's; `change` that from the first
    place to the last; `p_value` is two-sided; `p_value_given`: after what an attribute explains is taken out.
    """

    runs: int
    first: float
    last: float
    tau: float
    change: float
    p_value: float
    p_value_given: float


def rank_trend(values: Array, place: Array, attribute: Array) -> RankTrend | None:
    """Return the trend of values (n,) over `place` (n,); None with fewer than FEWEST_DRIFT_RUNS that are finite.

    What a straight line over the attribute (n,) explains is taken out for `p_value_given`.
    """
    known = np.isfinite(values)
    order = np.flatnonzero(known)[np.argsort(place[known], kind="stable")]
    if len(order) < FEWEST_DRIFT_RUNS:
        return None
    order = order[:: -(-len(order) // MOST_PAIRS_RUNS)]
    level, x, given = values[order], place[order], attribute[order]
    tau, p_value, rate = _mann_kendall(x, level)
    rest = level
    if np.isfinite(given).all() and np.ptp(given) > 0:
        basis = np.column_stack([np.ones(len(given)), given - given.mean()])
        rest = level - basis @ np.linalg.lstsq(basis, level, rcond=None)[0]
    third = len(order) // 3
    first, last = (float(np.median(part)) for part in (level[:third], level[-third:]))
    change = float(rate * np.ptp(x))
    return RankTrend(len(order), first, last, tau, change, p_value, _mann_kendall(x, rest)[1])


def _mann_kendall(x: Array, y: Array) -> tuple[float, float, float]:
    """Return Kendall's tau of y against x, its two-sided p-value without a trend, and the median slope of all pairs."""
    i, j = np.triu_indices(len(x), 1)
    run, rise = x[j] - x[i], y[j] - y[i]
    concordance = np.sign(run) * np.sign(rise)
    score, n = float(concordance.sum()), len(x)
    ties = [_tie_term(np.unique(values, return_counts=True)[1]) for values in (x, y)]
    untied = n * (n - 1) * (2 * n + 5)
    variance = (untied - ties[0] - ties[1]) / 18.0
    if variance <= 0 or not np.any(run != 0):
        return 0.0, 1.0, 0.0
    z = max(abs(score) - 1.0, 0.0) / np.sqrt(variance)  # continuity: the score changes in steps of two
    slope = float(np.median(rise[run != 0] / run[run != 0]))
    return score / len(run), float(2.0 * ndtr(-z)), slope


def _tie_term(counts: NDArray[np.int64]) -> float:
    return float(np.sum(counts * (counts - 1) * (2 * counts + 5)))
