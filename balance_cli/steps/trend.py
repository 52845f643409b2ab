"""Loads of many runs against their conditions and against time: trends, outliers among repeats, and drift of the fit.

- A trend is the weighted regression of a load on one attribute of the runs. Its standard error contains the scatter
  about the line, which holds what the other conditions do.
- Repeats are runs of the same conditions. The one that differs most from the mean of the others is tested with
  Student's t (Grubbs, Technometrics 11, 1969, 1), then the next, corrected for the number of comparisons. The stated
  sigmas weigh runs against each other; where the scatter is less, it gives their level, because repeats have the errors
  of response and calibration in common.
- Whether the residual test of the redundant channels worsens in the course of the runs is asked of ranks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr

from balance_cli.io.errors import UserError
from balance_cli.reduction.result import RunLoads
from balance_cli.steps.rank_trend import rank_trend
from balance_cli.steps.trend_points import TrendPoint

Array = NDArray[np.float64]

SIGNIFICANCE = 0.01
"""p-value, corrected for the number of comparisons, below which a run is an outlier or a drift is stated."""
SAME_VALUE = 1e-6
"""Relative range of an attribute up to which it does not vary: the clocks that speeds come from are known to some parts
per million, and numbers of single precision to 6e-8. Runs at a constant speed differ by rounding, 1e-12, alone."""
FEWEST_REPEATS = 4
"""Runs of one condition from which an outlier can be told: Student's t of three has one degree of freedom."""
SCATTER_QUANTILE, OF_NORMAL, EFFICIENCY = 0.8, 1.2816, 0.6
"""Quantile of the sizes of departures that the scatter of repeats comes from: one run in five may be an outlier, and
heavy tails count. Its value for a normal variable of unit variance, and the efficiency of such a scatter."""


@dataclass(frozen=True)
class LoadTrend:
    """Change of a quantity of a component with an attribute; the slope is NaN where that does not vary.

    Differences up to SAME_VALUE do not count. `scatter` is the rms about the line over that of the stated sigmas.
    """

    component: str
    quantity: str
    unit: str
    runs: int
    slope: float
    sigma_slope: float
    intercept: float
    p_value: float
    scatter: float


@dataclass(frozen=True)
class Outlier:
    """A run that differs from its repeats: its value, the mean of the others, and how many there are."""

    run: str
    component: str
    quantity: str
    value: float
    mean_of_others: float
    others: int
    bonferroni_p_value: float


@dataclass(frozen=True)
class RedundancyDrift:
    """Course of the residual test over the runs.

    `first` and `last` are medians over the first and the last third of the runs of the mean chi-square per degree of
    freedom; `tau` is Kendall's; `factor` that of the change from the first run to the last; `p_value` is two-sided;
    `p_value_given`: after what the attribute explains is taken out.
    """

    runs: int
    first: float
    last: float
    tau: float
    factor: float
    p_value: float
    p_value_given: float

    @property
    def is_significant(self) -> bool:
        """Whether there is a drift that the attribute does not explain."""
        return max(self.p_value, self.p_value_given) < SIGNIFICANCE


def load_trends(points: Sequence[TrendPoint], attribute: Array) -> tuple[LoadTrend, ...]:
    """Return the trend of the mean and of the blade harmonic of each component over an attribute (n,)."""
    trends = []
    for component in points[0].components:
        for quantity in points[0].quantities:
            values, sigmas = _series(points, component, quantity)
            known = np.isfinite(values) & np.isfinite(attribute)
            unit = points[0].unit(component)
            fit = _line(attribute[known], values[known], sigmas[known])
            trends.append(LoadTrend(component, quantity, unit, int(known.sum()), *fit))
    return tuple(trends)


def _series(points: Sequence[TrendPoint], component: str, quantity: str) -> tuple[Array, Array]:
    pairs = [point.value(component, quantity) for point in points]
    return np.array([value for value, _ in pairs]), np.array([sigma for _, sigma in pairs])


def _line(x: Array, y: Array, sigma: Array) -> tuple[float, float, float, float, float]:
    """Return slope, its standard error, intercept, p-value of the slope, and scatter over stated sigma."""
    nan = float("nan")
    if len(x) < 3 or np.ptp(x) <= SAME_VALUE * np.max(np.abs(x)):
        scatter = np.std(y, ddof=1) / np.sqrt(np.mean(sigma**2)) if len(y) > 1 and np.all(sigma > 0) else nan
        return nan, nan, float(np.mean(y)) if len(y) else nan, nan, float(scatter)
    weight = 1.0 / np.maximum(sigma, np.finfo(float).tiny) ** 2 if np.all(sigma > 0) else np.ones(len(x))
    # Weights by stated noise alone would let one quiet run decide: the scatter between runs is added to each.
    weight = 1.0 / (1.0 / weight + _excess_variance(x, y, weight))
    center = np.sum(weight * x) / np.sum(weight)
    spread = np.sum(weight * (x - center) ** 2)
    mean = np.sum(weight * y) / np.sum(weight)
    slope = np.sum(weight * (x - center) * (y - mean)) / spread
    residual = y - mean - slope * (x - center)
    dof = len(x) - 2
    sigma_slope = np.sqrt(max(1.0, np.sum(weight * residual**2) / dof) / spread)
    scatter = np.sqrt(np.mean(residual**2) / np.mean(sigma**2)) if np.all(sigma > 0) else nan
    p_value = 2.0 * stdtr(dof, -abs(slope) / sigma_slope) if sigma_slope > 0 else nan
    return float(slope), float(sigma_slope), float(mean - slope * center), float(p_value), float(scatter)


def _excess_variance(x: Array, y: Array, weight: Array) -> float:
    """Return the variance between runs beyond their stated one, about a straight line."""
    basis = np.column_stack([np.ones(len(x)), x - x.mean()])
    coefficients = np.linalg.lstsq(basis, y, rcond=None)[0]
    variance = np.sum((y - basis @ coefficients) ** 2) / (len(x) - 2)
    return float(max(0.0, variance - np.mean(1.0 / weight)))


# ---- repeats ---------------------------------------------------------------------------------------------------------


def find_outliers(points: Sequence[TrendPoint], groups: Sequence[Sequence[int]]) -> tuple[Outlier, ...]:
    """Return the runs that differ from their repeats; `groups` are indices of runs of the same conditions."""
    large = [group for group in groups if len(group) >= FEWEST_REPEATS]
    kinds = [(component, quantity) for component in points[0].components for quantity in points[0].quantities]
    comparisons = sum(map(len, large)) * len(kinds)
    outliers = []
    for component, quantity in kinds:
        groups_of_kind = [_series([points[index] for index in group], component, quantity) for group in large]
        own, dof = _own_share(groups_of_kind)
        for group, (values, sigmas) in zip(large, groups_of_kind, strict=True):
            for index, mean, others, p_value in _outliers(values, own * sigmas, dof, comparisons):
                name = points[group[index]].run
                outliers.append(Outlier(name, component, quantity, float(values[index]), mean, others, p_value))
    return tuple(sorted(outliers, key=lambda item: item.bonferroni_p_value))


def _own_share(groups: Sequence[tuple[Array, Array]]) -> tuple[float, float]:
    """Return the share of the stated sigmas that is each run's own, at most one, and its degrees of freedom.

    It comes from the scatter of all repeats.
    """
    ratios = []
    for values, sigmas in groups:
        known = np.isfinite(values) & (sigmas > 0)
        n = np.count_nonzero(known)
        if n >= FEWEST_REPEATS:
            size = np.abs(values[known] - np.median(values[known])) / sigmas[known]
            ratios.append(size * np.sqrt(n / (n - 1.0)) / OF_NORMAL)
    if not ratios:
        return 1.0, 0.0
    every = np.concatenate(ratios)
    return min(1.0, float(np.quantile(every, SCATTER_QUANTILE))), EFFICIENCY * (len(every) - len(ratios))


def _outliers(values: Array, sigmas: Array, dof: float, comparisons: int) -> list[tuple[int, float, int, float]]:
    """Return index, mean of the others, their number and corrected p-value of each outlier, the worst first.

    A run is compared with the scatter of the others or with its sigma, of `dof` degrees of freedom, if that is more.
    """
    left = np.flatnonzero(np.isfinite(values))
    outliers = []
    while len(left) >= FEWEST_REPEATS:
        x, n = values[left], len(left)
        mean = (x.sum() - x) / (n - 1)
        variance = np.maximum((np.sum((x - x.mean()) ** 2) - (x - mean) ** 2 * (n - 1) / n) / (n - 2), 0.0)
        stated = np.nan_to_num(sigmas[left]) ** 2
        scale = np.sqrt(np.maximum(variance, stated) * (1.0 + 1.0 / (n - 1)))
        t = np.divide(np.abs(x - mean), scale, out=np.zeros(n), where=scale > 0)
        p_values = 2.0 * stdtr(np.where(stated > variance, max(n - 2.0, dof), n - 2.0), -t)
        worst = int(np.argmin(p_values))
        p_value = min(1.0, comparisons * float(p_values[worst]))
        if p_value >= SIGNIFICANCE:
            break
        outliers.append((int(left[worst]), float(mean[worst]), n - 1, p_value))
        left = np.delete(left, worst)
    return outliers


# ---- drift of the residual test --------------------------------------------------------------------------------------


def mean_redundancy(loads: RunLoads) -> float:
    """Return the mean over the harmonics of chi-square per degree of freedom; NaN without redundant channels."""
    tested = loads.redundancy[1:][np.isfinite(loads.redundancy[1:])]
    return float(np.mean(tested)) if len(tested) else float("nan")


def redundancy_drift(redundancy: Array, place: Array, attribute: Array) -> RedundancyDrift | None:
    """Return the drift of the residual test (n,) over `place` (n,), time or number; None with too few runs.

    What a straight line over the attribute (n,) explains of its logarithm is taken out for `p_value_given`.
    """
    level = np.log(np.where(redundancy > 0, redundancy, np.nan))
    trend = rank_trend(level, place, attribute)
    if trend is None:
        return None
    first, last, factor = (float(np.exp(value)) for value in (trend.first, trend.last, trend.change))
    return RedundancyDrift(trend.runs, first, last, trend.tau, factor, trend.p_value, trend.p_value_given)


def require_runs(points: Sequence[TrendPoint]) -> None:
    """Raise UserError for fewer than two runs, for one name twice, and for runs of different components."""
    if len(points) < 2:
        raise UserError("one run has no trend", "LOADS...", remedy="Give the loads of several runs")
    file_of_run: dict[str, str] = {}
    for point in points:
        if point.run in file_of_run:
            fault = f"has the run `{point.run}`, which {file_of_run[point.run]} has too"
            raise UserError(fault, point.file, "runs", "Run names are unique: give each run once")
        file_of_run[point.run] = point.file
        if point.components != points[0].components:
            fault = f"has the components {', '.join(point.components)}, {points[0].file} has others"
            raise UserError(fault, point.file, remedy="Give loads of one balance")
