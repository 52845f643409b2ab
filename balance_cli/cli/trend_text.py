"""All trends of a set of runs, and what `balance trend` says of them: text and JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from balance_cli.io.result_view import plural
from balance_cli.reduction.operational_modes import OperationalModes
from balance_cli.steps.mode_trend import ModeTrend, mode_trends
from balance_cli.steps.rank_trend import FEWEST_DRIFT_RUNS
from balance_cli.steps.repeat_drift import RepeatDrift, find_repeat_drifts
from balance_cli.steps.trend import (
    FEWEST_REPEATS,
    SIGNIFICANCE,
    LoadTrend,
    Outlier,
    RedundancyDrift,
    find_outliers,
    load_trends,
    mean_redundancy,
    redundancy_drift,
    require_runs,
)
from balance_cli.steps.trend_points import TrendPoint, attribute_values, repeats, sequence

Array = NDArray[np.float64]

MOST_OUTLIERS = 20
"""Outliers of the text; the JSON has all."""


@dataclass(frozen=True)
class TrendResult:
    """The points, their places in the campaign and attribute values, and what was found.

    `modes` is None where eigenfrequencies were not asked for.
    """

    points: Sequence[TrendPoint]
    attribute: str
    values: Array
    place: Array
    place_unit: str
    redundancy: Array
    trends: tuple[LoadTrend, ...]
    groups: list[list[int]]
    outliers: tuple[Outlier, ...]
    repeat_drifts: tuple[RepeatDrift, ...]
    drift: RedundancyDrift | None
    run_modes: Mapping[str, OperationalModes] = field(default_factory=dict)
    modes: tuple[ModeTrend, ...] | None = None

    @property
    def order(self) -> list[int]:
        """Indices of the points in the order of the campaign."""
        return [int(index) for index in np.argsort(self.place, kind="stable")]

    @property
    def repeats(self) -> list[list[int]]:
        """The groups of repeats that are large enough to tell an outlier."""
        return [group for group in self.groups if len(group) >= FEWEST_REPEATS]


def find_trends(
    points: Sequence[TrendPoint], attribute: str, run_modes: Mapping[str, OperationalModes] | None
) -> TrendResult:
    """Return all trends. Raises UserError for an attribute that no run has, and for too few or mixed runs.

    `run_modes`: the eigenfrequencies of the runs by name, where they are followed.
    """
    require_runs(points)
    values = attribute_values(points, attribute)
    place, unit = sequence(points)
    redundancy = np.array([mean_redundancy(point.loads) for point in points])
    groups = repeats(points)
    return TrendResult(
        points,
        attribute,
        values,
        place,
        unit,
        redundancy,
        load_trends(points, values),
        groups,
        find_outliers(points, groups),
        find_repeat_drifts(points, groups, place),
        redundancy_drift(redundancy, place, values),
        run_modes or {},
        None if run_modes is None else mode_trends(points, run_modes, place, values),
    )


def trend_summary(result: TrendResult) -> dict[str, Any]:
    """Return the summary (docs/json.md)."""
    points = [result.points[index] for index in result.order]
    drift = result.drift
    return {
        "by": result.attribute,
        "place_unit": result.place_unit,
        "trends": [asdict(trend) for trend in result.trends],
        "repeats": [[result.points[index].run for index in group] for group in result.repeats],
        "outliers": [asdict(item) for item in result.outliers],
        "repeat_drifts": [asdict(item) for item in result.repeat_drifts],
        "redundancy_drift": None if drift is None else asdict(drift) | {"is_significant": drift.is_significant},
        "modes": None
        if result.modes is None
        else [asdict(mode) | {"is_significant": mode.is_significant} for mode in result.modes],
        "runs": {
            point.run: {
                "file": point.file,
                "place": result.place[index],
                "value": result.values[index],
                "redundancy": result.redundancy[index],
            }
            | _modes_of_run(result.run_modes.get(point.run))
            for index, point in zip(result.order, points, strict=True)
        },
    }


def _modes_of_run(modes: OperationalModes | None) -> dict[str, Any]:
    return {} if modes is None else {"frequency_hz": modes.frequency, "sigma_frequency_hz": modes.sigma}


def trend_text(result: TrendResult) -> Iterator[str]:
    """Yield the text for the user."""
    yield f"{plural(len(result.points), 'run')} over {result.attribute} ({_span(result.values)})"
    head = ("", "quantity", "slope", "sigma", "p-value", "scatter/sigma")
    yield "   {:10}{:>10}{:>13}{:>11}{:>10}{:>15}".format(*head)
    for trend in result.trends:
        name = f"{trend.component} {trend.unit}"
        line = (f"{trend.slope:13.4g}", f"{trend.sigma_slope:11.2g}", f"{trend.p_value:10.2g}")
        numbers = "".join(line) if math.isfinite(trend.slope) else " " * len("".join(line))
        yield f"   {name:10}{trend.quantity:>10}{numbers}{trend.scatter:15.3g}"
    if not any(math.isfinite(trend.slope) for trend in result.trends):
        yield f"   no slopes: they need three runs, not all at one value of {result.attribute}"
    yield from _outlier_text(result)
    yield from _drift_text(result)
    if result.modes is not None:
        yield from _mode_text(result, result.modes)


def _span(values: Array) -> str:
    known = values[np.isfinite(values)]
    return f"{known.min():.5g} to {known.max():.5g}"


def _outlier_text(result: TrendResult) -> Iterator[str]:
    groups = result.repeats
    if not groups:
        yield f"repeats: no {FEWEST_REPEATS} runs of the same attributes and speed; outliers are not testable"
        return
    runs = sum(map(len, groups))
    yield f"repeats: {runs} runs in {len(groups)} groups of the same attributes and speed; {_count(result.outliers)}"
    for item in result.outliers[:MOST_OUTLIERS]:
        change = f"{item.value:.5g}, mean of {item.others} others {item.mean_of_others:.5g}"
        yield f"   {item.run}: {item.component} {item.quantity} {change} (p = {item.bonferroni_p_value:.1g})"
    if len(result.outliers) > MOST_OUTLIERS:
        yield f"   and {len(result.outliers) - MOST_OUTLIERS} more (--json lists all)"
    for drift in result.repeat_drifts:
        change = f"{drift.last - drift.first:+.3g} {drift.unit} from the first third to the last"
        test = f"of typically {drift.typical:.4g} (p = {drift.bonferroni_p_value:.1g})"
        yield f"   {drift.component} {drift.quantity} drifts among repeats: {change}, {test}"
    if result.repeat_drifts:
        yield "   rotor, rig or zero has changed, or the model no longer holds: no residual test need show it"


def _count(outliers: Sequence[Outlier]) -> str:
    return plural(len(outliers), "outlier") if outliers else "no outlier"


def _drift_text(result: TrendResult) -> Iterator[str]:
    drift = result.drift
    if drift is None:
        yield f"residual test: fewer than {FEWEST_DRIFT_RUNS} runs with redundant channels; its drift is not testable"
        return
    span = "in the order given" if result.place_unit == "runs" else f"over {np.ptp(result.place):.3g} days"
    change = f"from {drift.first:.3g} (first third) to {drift.last:.3g} (last third)"
    yield f"residual test {span}: mean redundancy {change}, tau {drift.tau:.2f}, p = {drift.p_value:.2g}"
    if not drift.is_significant:
        explained = drift.p_value < drift.p_value_given and not math.isnan(drift.p_value_given)
        reason = f"; {result.attribute} explains it" if explained and drift.p_value < SIGNIFICANCE else ""
        yield f"   no significant drift{reason}"
    elif drift.factor > 1.0:
        yield f"   it grows by a factor of {drift.factor:.3g}: the model wears out; identify it anew"
    else:
        yield f"   it falls by a factor of {1.0 / drift.factor:.3g}"


def _mode_text(result: TrendResult, modes: Sequence[ModeTrend]) -> Iterator[str]:
    """Yield the eigenfrequencies that show between the harmonics, and which of them drift."""
    shown = [mode for mode in modes if mode.runs]
    if not shown:
        yield f"eigenfrequencies of {len(result.run_modes)} runs: none shows between the harmonics; not testable"
        return
    yield f"eigenfrequencies of {len(result.run_modes)} runs, departure in % from those of the model at the same speed"
    head = ("mode", "model Hz", "runs", "mean", "sigma", "first third", "last third", "p-value")
    yield "   {:>4}{:>10}{:>7}{:>9}{:>8}{:>13}{:>12}{:>10}".format(*head)
    for mode in shown:
        percent = [100.0 * value for value in (mode.departure, mode.sigma_departure, mode.first, mode.last)]
        numbers = "{:9.2f}{:8.2f}{:13.2f}{:12.2f}".format(*percent)
        yield f"   {mode.mode:4d}{mode.frequency_hz:10.2f}{mode.runs:7d}{numbers}{mode.bonferroni_p_value:10.2g}"
    hidden = ", ".join(f"{mode.mode} ({mode.frequency_hz:.2f} Hz)" for mode in modes if not mode.runs)
    if hidden:
        yield f"   not followed: mode {hidden}: records too short, little turbulence, or a harmonic beside it"
    drifting = [mode for mode in shown if mode.is_significant]
    for mode in drifting:
        way = "rises" if mode.change > 0 else "falls"
        change = f"by {100 * abs(mode.last - mode.first):.2g} % from the first third to the last"
        yield f"   mode {mode.mode} {way} {change}: stiffness or mass has changed; identify the model anew"
    if not drifting:
        tested = any(not math.isnan(mode.bonferroni_p_value) for mode in shown)
        yield (
            "   no significant drift of these"
            if tested
            else f"   fewer than {FEWEST_DRIFT_RUNS} runs: drift is not testable"
        )
