"""Whether the loads of repeats drift in the course of a campaign, by aligned ranks.

A balance with as many sensors as loads has no residual test of its mechanics: a cell that has become softer moves a
load by any amount, and only repeats show it. The departures of all runs from the mean of their repeats are ranked
together (Hodges and Lehmann, Ann. Math. Stat. 33, 1962, 482), and the ranks are correlated with the place of the runs,
from which the mean of the repeats is taken, too. A step amid the campaign shows as well as a steady drift.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr

from balance_cli.steps.rank_trend import FEWEST_DRIFT_RUNS
from balance_cli.steps.trend import FEWEST_REPEATS, SIGNIFICANCE
from balance_cli.steps.trend_points import TrendPoint

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RepeatDrift:
    """Course of a load over the campaign, as departure from the mean of the repeats of each run.

    `first` and `last` are medians over the first and the last third of the runs; `typical` is the median of the values;
    `correlation` is that of ranks and place. The p-value is two-sided, and corrected for the number of loads.
    """

    component: str
    quantity: str
    unit: str
    runs: int
    typical: float
    first: float
    last: float
    correlation: float
    bonferroni_p_value: float


def find_repeat_drifts(
    points: Sequence[TrendPoint], groups: Sequence[Sequence[int]], place: Array
) -> tuple[RepeatDrift, ...]:
    """Return the loads that drift over `place` (n,) among repeats, the clearest first.

    `groups` are indices of runs of the same conditions; those of fewer than FEWEST_REPEATS runs are left out.
    """
    large = [np.asarray(group, int) for group in groups if len(group) >= FEWEST_REPEATS]
    kinds = [(component, quantity) for component in points[0].components for quantity in points[0].quantities]
    if not large:
        return ()
    candidates = [_drift(points, large, place, component, quantity, len(kinds)) for component, quantity in kinds]
    drifts = [item for item in candidates if item is not None and item.bonferroni_p_value < SIGNIFICANCE]
    return tuple(sorted(drifts, key=lambda item: item.bonferroni_p_value))


def _drift(
    points: Sequence[TrendPoint],
    groups: Sequence[NDArray[np.int64]],
    place: Array,
    component: str,
    quantity: str,
    tests: int,
) -> RepeatDrift | None:
    values = np.array([point.value(component, quantity)[0] for point in points])
    known = [group[np.isfinite(values[group])] for group in groups]
    rows = np.concatenate(known)
    label = np.repeat(np.arange(len(known)), [len(group) for group in known])
    dof = len(rows) - len(np.unique(label)) - 1
    if len(rows) < FEWEST_DRIFT_RUNS or dof < 1:
        return None
    departure, course = _less_mean(values[rows], label), _less_mean(place[rows], label)
    ranks = _less_mean(np.unique(departure, return_inverse=True)[1].astype(float), label)
    size = np.sqrt(np.sum(ranks**2) * np.sum(course**2))
    correlation = float(ranks @ course / size) if size > 0 else 0.0
    t = abs(correlation) * np.sqrt(dof / max(1.0 - correlation**2, np.finfo(float).tiny))
    ordered, third = departure[np.argsort(place[rows], kind="stable")], len(rows) // 3
    return RepeatDrift(
        component,
        quantity,
        points[0].unit(component),
        len(rows),
        float(np.median(values[rows])),
        float(np.median(ordered[:third])),
        float(np.median(ordered[-third:])),
        correlation,
        min(1.0, tests * 2.0 * float(stdtr(dof, -t))),
    )


def _less_mean(values: Array, label: NDArray[np.int64]) -> Array:
    """Return values (n,) less the mean of those with the same label (n,)."""
    means = np.bincount(label, values) / np.maximum(np.bincount(label), 1)
    return np.asarray(values - means[label])
