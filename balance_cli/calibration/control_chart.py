"""Control chart of the coefficients of a balance over many calibrations: scatter, drift, and the newest against limits.

Each coefficient has a value and a standard error in every calibration. Three questions are answered for it
(NIST/SEMATECH e-Handbook of Statistical Methods, sections 2.2 and 6.3; Shewhart, 1931):

- Do the calibrations differ by more than their errors? Welch's test of the scatter about the weighted mean.
- Does it drift? A weighted straight line over the calibrations in their order. Where the scatter about it exceeds the
  errors, its standard error is that of the scatter.
- Is the newest within the limits of the earlier ones? Mean and standard deviation of these, with the probability of the
  three-sigma limits of Shewhart for as few as there are.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.comparison import coefficients_at_range, model_at_temperature, require_same_balance
from balance_cli.calibration.gain_trend import GainTrend, gain_trends
from balance_cli.calibration.result import Calibration
from balance_cli.signals import distributions as stats

Array = NDArray[np.float64]

MIN_CALIBRATIONS = 3
"""Calibrations that a drift with a residual needs: a line through two leaves no degree of freedom."""
SIGNIFICANCE_LEVEL = 0.01
"""Probability that any coefficient of an unchanged balance is said to drift (Bonferroni over all of them)."""
EXCESS_SCATTER_P_VALUE = 0.05
"""P-value of the scatter about the line below which it replaces the stated errors."""
LIMIT_P_VALUE = 0.0027
"""Probability that an unchanged coefficient is beyond its limits: that of three standard deviations."""


@dataclass(frozen=True, eq=False)
class CoefficientHistory:
    """One coefficient of a channel over n calibrations, as reading at the newest calibrated range.

    `values` (n,) and `sigma` (n,), NaN where the calibration does not state its errors; `mean`: weighted. `scatter_p`:
    p-value of the scatter about the mean. `drift` per calibration with `drift_sigma` and `drift_p`. `low` and `high`:
    limits of the newest by the earlier ones. NaN where the calibrations do not tell.
    """

    channel: str
    term: str
    unit: str
    values: Array
    sigma: Array
    mean: float
    scatter_p: float
    drift: float
    drift_sigma: float
    drift_p: float
    low: float
    high: float

    @property
    def key(self) -> tuple[str, str]:
        """Channel and term."""
        return self.channel, self.term

    @property
    def is_out_of_control(self) -> bool:
        """Whether the newest value is beyond its limits."""
        return bool(self.values[-1] < self.low or self.values[-1] > self.high)


@dataclass(frozen=True)
class ControlChart:
    """The coefficients that all calibrations have, `names`, the oldest first, by rising p-value of their drift.

    `gain_trends`: the channels whose gain for all loads rises or falls from calibration to calibration.
    """

    names: tuple[str, ...]
    coefficients: tuple[CoefficientHistory, ...]
    gain_trends: tuple[GainTrend, ...] = ()

    @property
    def p_limit(self) -> float:
        """P-value of one coefficient below which its drift or scatter is significant (Bonferroni)."""
        return SIGNIFICANCE_LEVEL / max(len(self.coefficients), 1)

    @property
    def drifting_coefficients(self) -> tuple[CoefficientHistory, ...]:
        """The coefficients whose drift is significant."""
        return tuple(each for each in self.coefficients if each.drift_p < self.p_limit)

    @property
    def scattering_coefficients(self) -> tuple[CoefficientHistory, ...]:
        """The coefficients that differ between the calibrations by significantly more than their errors."""
        return tuple(each for each in self.coefficients if each.scatter_p < self.p_limit)

    @property
    def out_of_control(self) -> tuple[CoefficientHistory, ...]:
        """The coefficients whose newest value is beyond the limits of the earlier ones."""
        return tuple(each for each in self.coefficients if each.is_out_of_control)

    @property
    def alarms(self) -> tuple[CoefficientHistory, ...]:
        """The coefficients that drift, differ by more than their errors or left their limits; worst drift first."""
        named = {
            each.key for each in (*self.drifting_coefficients, *self.scattering_coefficients, *self.out_of_control)
        }
        return tuple(each for each in self.coefficients if each.key in named)


def control_chart(named: Sequence[tuple[str, Calibration]]) -> ControlChart:
    """Make the control chart of calibrations of one balance, by name, the oldest first.

    Raises UserError where one has no model of all trims, or is of another balance.
    """
    return _chart_of_first(_collect_coefficients(named), len(named))


def running_control_charts(named: Sequence[tuple[str, Calibration]]) -> tuple[ControlChart, ...]:
    """Make the control charts that each calibration from the MIN_CALIBRATIONS-th on gave, with those before it.

    All are at the calibrated range of the newest; the last is that of `control_chart`. Raises UserError as that does.
    """
    table = _collect_coefficients(named)
    return tuple(_chart_of_first(table, n) for n in range(MIN_CALIBRATIONS, len(named) + 1))


def alarms_since(charts: Sequence[ControlChart]) -> dict[tuple[str, str], str]:
    """{(channel, term): calibration since which every chart raised an alarm of it}, for the alarms of the last chart.

    `charts` are those of `running_control_charts`.
    """
    since: dict[tuple[str, str], str] = {}
    for chart in charts:
        keys = {each.key for each in chart.alarms}
        since = {key: since.get(key, chart.names[-1]) for key in keys}
    return since


@dataclass(frozen=True, eq=False)
class _CoefficientTable:
    """Coefficients (n, p, c) of n calibrations and their variances, with degrees of freedom (n,) and units (c,).

    The first `linear` are those of the loads alone.
    """

    names: tuple[str, ...]
    channels: tuple[str, ...]
    terms: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    variances: Array
    dof: Array
    linear: int


def _collect_coefficients(named: Sequence[tuple[str, Calibration]]) -> _CoefficientTable:
    """Coefficients of all calibrations as readings at the calibrated range and the temperature of the newest."""
    models = [model_at_temperature(calibration, named[-1][1]) for _, calibration in named]
    newest = models[-1]
    for model in models:
        require_same_balance(newest, model)
    channels = tuple(name for name in newest.channel_names if all(name in model.channel_names for model in models))
    terms = tuple(dict.fromkeys(term for model in models for term in model.terms))
    tables = [coefficients_at_range(model, terms, channels, newest.calibrated_range) for model in models]
    values, variances = (np.stack(part) for part in zip(*tables, strict=True))
    units = {channel.name: channel.reading_unit for channel in named[-1][1].geometry.channels}
    dof = np.array([float(np.min(model.dof)) for model in models])
    names, channel_units = tuple(name for name, _ in named), tuple(units[channel] for channel in channels)
    return _CoefficientTable(names, channels, terms, channel_units, values, variances, dof, len(newest.components))


def _chart_of_first(table: _CoefficientTable, n: int) -> ControlChart:
    """The control chart of the first n calibrations."""
    values, variances, dof = table.values[:n], table.variances[:n], table.dof[:n]
    histories = [
        _history((channel, term, table.units[c]), values[:, i, c], variances[:, i, c], dof)
        for c, channel in enumerate(table.channels)
        for i, term in enumerate(table.terms)
        # Which of several similar terms a search selects, and whether a weak one, is no change of the balance.
        if np.all(values[:, i, c] != 0.0)
    ]
    ranked = sorted(histories, key=lambda each: np.nan_to_num(each.drift_p, nan=2.0))
    trends = gain_trends(table.channels, values[:, : table.linear], variances[:, : table.linear])
    return ControlChart(table.names[:n], tuple(ranked), trends)


def _history(key: tuple[str, str, str], values: Array, variance: Array, dof: Array) -> CoefficientHistory:
    """Statistics of one coefficient (n,) with degrees of freedom (n,) of its variances."""
    variance = np.where(variance > 0, variance, np.nan)
    if np.isfinite(variance).all() and len(values) >= MIN_CALIBRATIONS:
        mean, scatter_p = _scatter(values, variance, dof)
        drift = _drift(values, variance, float(np.min(dof)))
        limits = _limits(values[:-1], variance)
    else:
        mean, scatter_p, drift, limits = float(np.mean(values)), float("nan"), (float("nan"),) * 3, (float("nan"),) * 2
    return CoefficientHistory(
        *key,
        values=values,
        sigma=np.sqrt(variance),
        mean=mean,
        scatter_p=scatter_p,
        drift=drift[0],
        drift_sigma=drift[1],
        drift_p=drift[2],
        low=limits[0],
        high=limits[1],
    )


def _scatter(values: Array, variance: Array, dof: Array) -> tuple[float, float]:
    """Weighted mean, and p-value of the scatter about it.

    Chi-square would take the estimated variances as known, and call unchanged balances changed: Welch (1951),
    Biometrika 38, 330-336, gives the F-test for their degrees of freedom.
    """
    k, weight = len(values), 1.0 / variance
    mean = float(np.average(values, weights=weight))
    lack = float(np.sum((1.0 - weight / weight.sum()) ** 2 / dof))
    between = float(np.sum(weight * (values - mean) ** 2)) / (k - 1)
    ratio = between / (1.0 + 2.0 * (k - 2) / (k**2 - 1) * lack)
    return mean, float(stats.f.sf(ratio, k - 1, (k**2 - 1) / (3.0 * lack)))


def _drift(values: Array, variance: Array, dof: float) -> tuple[float, float, float]:
    """Slope per calibration, its standard error, and the p-value of no drift."""
    n = len(values)
    line = np.column_stack([np.ones(n), np.arange(n)]) / np.sqrt(variance)[:, None]
    inverse = np.linalg.inv(line.T @ line)
    coefficients = inverse @ (line.T @ (values / np.sqrt(variance)))
    chi2 = float(np.sum((values / np.sqrt(variance) - line @ coefficients) ** 2))
    exceeds = float(stats.chi2.sf(chi2, n - 2)) < EXCESS_SCATTER_P_VALUE
    sigma = float(np.sqrt(inverse[1, 1] * (chi2 / (n - 2) if exceeds else 1.0)))
    t = abs(float(coefficients[1])) / sigma
    return float(coefficients[1]), sigma, float(2.0 * stats.t.sf(t, n - 2 if exceeds else dof))


def _limits(earlier: Array, variance: Array) -> tuple[float, float]:
    """Limits of the newest value by the earlier ones (n - 1,), for its own error and their scatter."""
    n = len(earlier)
    mean, scatter = float(np.mean(earlier)), float(np.var(earlier, ddof=1))
    own = float(np.mean(variance[:-1]))
    exceeds = float(stats.chi2.sf((n - 1) * scatter / own, n - 1)) < EXCESS_SCATTER_P_VALUE
    factor = float(stats.t.isf(0.5 * LIMIT_P_VALUE, n - 1)) if exceeds else float(stats.norm.isf(0.5 * LIMIT_P_VALUE))
    # Beside the scatter from calibration to calibration the newest has its own error.
    new = max(scatter - own, 0.0) + float(variance[-1]) if exceeds else float(variance[-1])
    half = factor * float(np.sqrt(new + (scatter if exceeds else own) / n))
    return mean - half, mean + half


def chart_rows(chart: ControlChart) -> Iterator[dict[str, object]]:
    """The coefficients as rows of plain values, for JSON and tables."""
    for each in chart.coefficients:
        yield {
            "channel": each.channel,
            "term": each.term,
            "unit": each.unit,
            "values": each.values.tolist(),
            "sigma": each.sigma.tolist(),
            "mean": each.mean,
            "scatter_p": each.scatter_p,
            "drift": each.drift,
            "drift_sigma": each.drift_sigma,
            "drift_p": each.drift_p,
            "low": each.low,
            "high": each.high,
            "out_of_control": each.is_out_of_control,
        }
