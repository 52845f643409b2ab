"""Check standards over the campaigns: the control chart of the coefficients of a balance over its calibrations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.control_chart import (
    LIMIT_P_VALUE,
    MIN_CALIBRATIONS,
    CoefficientHistory,
    ControlChart,
    alarms_since,
    running_control_charts,
)
from balance_cli.calibration.result import Calibration
from balance_cli.io.errors import UserError
from balance_cli.report.blocks import Chart, PageBlock, Paragraph, Row, Section, Table, WarningText, plain_row
from balance_cli.report.figure_style import BLUE, GRAY, VERMILION
from balance_cli.report.number_format import format_fixed, format_significant, join_names, value_and_sigma_text
from balance_cli.report.plots import Plot, Trace
from balance_cli.report.sources import Source, Sources

Array = NDArray[np.float64]

SHOWN = 6
"""Coefficients that are drawn: three rows of two plots."""
NAMED = 3
"""Coefficients that the sentence names; the table has the others."""
LISTED = 24
"""Rows of the table: the alarms of a balance of six channels of which each has four."""
PERCENT = 100.0
Limits = dict[tuple[str, str], Array]


def section(sources: Sources) -> Section | None:
    """The control chart of the calibrations in the order given, the oldest first; None where they are too few."""
    named = _name_calibrations(sources.calibrations)
    if len(named) < MIN_CALIBRATIONS:
        return None
    try:
        charts = running_control_charts(named)
    except UserError as error:
        blocks: tuple[PageBlock, ...] = (Paragraph(f"No control chart of these calibrations: one {error.fault}."),)
    else:
        blocks = tuple(_chart_blocks(charts))
    return Section("calibration-history", "Check standards over the campaigns", blocks)


def _name_calibrations(sources: Sequence[Source[Calibration]]) -> list[tuple[str, Calibration]]:
    """Calibrations of different runs by the names of their files; those of the same runs count once."""
    different: dict[tuple[tuple[str, str], ...], Source[Calibration]] = {}
    for source in sources:
        # An earlier calibration that `calibrate --against` read does not enter the result.
        read = (item for item in source.artefact.provenance.inputs if item.role != "calibration")
        inputs = tuple(sorted((item.role, item.digest) for item in read))
        different.setdefault(inputs or (("", source.artefact.digest),), source)
    count = Counter(source.file for source in different.values())
    return [
        (source.file if count[source.file] == 1 else f"{source.file} ({number})", source.content)
        for number, source in enumerate(different.values(), 1)
    ]


def _chart_blocks(charts: Sequence[ControlChart]) -> Iterator[PageBlock]:
    chart, since = charts[-1], alarms_since(charts)
    sentence = verdict(chart, since)
    yield WarningText(sentence) if chart.alarms else Paragraph(sentence)
    if not any(np.isfinite(each.drift_p) for each in chart.coefficients):
        return
    ranked = _rank(chart)
    limits = _running_limits(charts)
    names = ", ".join(f"{number} {name}" for number, name in enumerate(chart.names, 1))
    caption = (
        f"Control chart of the coefficients, at the newest calibrated range: {names}. Blue: coefficients with their "
        "errors (two standard deviations); dashed: limits of each calibration by those before it "
        f"(p {LIMIT_P_VALUE:g}); red: beyond them. Alarms come first, then the least likely drifts."
    )
    plots = tuple(_plot(each, limits[each.key], len(chart.names)) for each in ranked[:SHOWN])
    yield Chart.single("control-chart", caption, plots)
    yield _table(chart, ranked[: max(SHOWN, min(len(chart.alarms), LISTED))], since)


def _rank(chart: ControlChart) -> tuple[CoefficientHistory, ...]:
    """The coefficients with an alarm first, each part by rising p-value of drift or scatter."""
    alarms = {each.key for each in chart.alarms}
    worst = {each.key: np.nan_to_num(min(each.drift_p, each.scatter_p), nan=2.0) for each in chart.coefficients}
    return tuple(sorted(chart.coefficients, key=lambda each: (each.key not in alarms, worst[each.key])))


# ---- sentence --------------------------------------------------------------------------------------------------------


def verdict(chart: ControlChart, since: Mapping[tuple[str, str], str]) -> str:
    """Say whether the balance is in control; else which coefficients are not, how, and since which calibration."""
    count, n = len(chart.coefficients), len(chart.names)
    tested = sum(bool(np.isfinite(each.drift_p)) for each in chart.coefficients)
    if not tested:
        return f"Not tested: {n} calibrations do not all state the errors of their coefficients."
    of_all = f"{count} coefficients over {n} calibrations, {chart.names[0]} to {chart.names[-1]}"
    untested = f" {count - tested} are not tested: their errors are not stated." if tested < count else ""
    if not chart.alarms:
        return f"In control: none of {of_all}, drifts, scatters beyond its errors or is beyond its limits.{untested}"
    ranked = _rank(chart)[: len(chart.alarms)]
    named = "; ".join(_alarm_text(chart, each, since[each.key]) for each in ranked[:NAMED])
    more = f"; and {len(ranked) - NAMED} more" if len(ranked) > NAMED else ""
    significant = bool(chart.drifting_coefficients or chart.scattering_coefficients)
    start = "Not in control" if significant else "To be watched"
    by_chance = "" if significant else _chance_text(tested)
    return f"{start}: {len(ranked)} of {of_all}: {named}{more}.{by_chance}{untested}"


def _alarm_text(chart: ControlChart, each: CoefficientHistory, since: str) -> str:
    words = []
    if each in chart.drifting_coefficients:
        words.append(f"drifts by {_size_text(each, each.drift)} a calibration (p {each.drift_p:.2g})")
    elif each in chart.scattering_coefficients:
        words.append(f"differs by more than its errors (p {each.scatter_p:.2g})")
    if each.is_out_of_control:
        words.append(f"newest {_size_text(each, each.values[-1] - each.mean)} from the mean, beyond its limits")
    first = chart.names[MIN_CALIBRATIONS - 1]
    when = f"by {first} or before" if since == first else f"since {since}"
    return f"{each.channel} {each.term} {join_names(words)}, {when}"


def _chance_text(tested: int) -> str:
    return (
        f" No drift is significant; of {tested} coefficients of an unchanged balance, "
        f"{format_significant(tested * LIMIT_P_VALUE, 2)} are expected beyond their limits."
    )


def _size_text(each: CoefficientHistory, value: float) -> str:
    sign = "+" if value > 0 else ""
    if _is_percent(each):
        return f"{sign}{format_significant(PERCENT * value / abs(each.mean))} %"
    return f"{sign}{format_significant(value)} {each.unit}"


def _is_percent(each: CoefficientHistory) -> bool:
    """Whether the mean is known well enough to count in percent of it."""
    return bool(abs(each.mean) > float(np.nanmean(each.sigma)))


# ---- picture and table -----------------------------------------------------------------------------------------------


def _running_limits(charts: Sequence[ControlChart]) -> Limits:
    """Limits (2, n) of each calibration by those before it, NaN where these were too few."""
    n = len(charts[-1].names)
    limits = {each.key: np.full((2, n), np.nan) for each in charts[-1].coefficients}
    for chart in charts:
        for each in chart.coefficients:
            limits[each.key][:, len(chart.names) - 1] = each.low, each.high
    return limits


def _plot(each: CoefficientHistory, limits: Array, n: int) -> Plot:
    scale = PERCENT / abs(each.mean) if _is_percent(each) else 1.0
    values, error = scale * (each.values - each.mean), 2.0 * scale * each.sigma
    low, high = scale * (limits - each.mean)
    outside = (values < low) | (values > high)
    dashes = (4.0, 3.0)
    traces = (
        Trace("coefficient", values, BLUE, width=0.8, band=np.array([values - error, values + error])),
        Trace("value", values, BLUE, points=True),
        Trace("lower limit", low, GRAY, dashes, 1.0),
        Trace("upper limit", high, GRAY, dashes, 1.0),
        *([Trace("beyond limits", np.where(outside, values, np.nan), VERMILION, points=True)] if any(outside) else ()),
    )
    unit = "%" if _is_percent(each) else each.unit
    label = f"less mean [{unit}]"
    return Plot(f"{each.channel} {each.term}", np.arange(1.0, n + 1.0), traces, "calibration [1]", label)


def _table(chart: ControlChart, shown: Sequence[CoefficientHistory], since: Mapping[tuple[str, str], str]) -> Table:
    columns = ("channel", "term", "mean", "newest less mean", "limits", "drift a calibration", "p of drift")
    head = plain_row(*columns, "p of scatter", "alarm since")
    rows = tuple(_table_row(each, since.get(each.key, "")) for each in shown)
    caption = (
        f"Coefficients as readings at the newest calibrated range: {len(shown)} of {len(chart.coefficients)}. A drift "
        f"or a scatter is significant below p = {format_significant(chart.p_limit, 2)}."
    )
    return Table(caption, (head,), rows)


def _table_row(each: CoefficientHistory, since: str) -> Row:
    drift = " \N{PLUS-MINUS SIGN} ".join(value_and_sigma_text(each.drift, each.drift_sigma))
    limits = " to ".join(_size_text(each, limit - each.mean) for limit in (each.low, each.high))
    texts = (
        each.channel,
        each.term,
        f"{format_significant(each.mean, 5)} {each.unit}",
        _size_text(each, each.values[-1] - each.mean),
        limits,
        f"{drift} {each.unit}",
        _p_text(each.drift_p),
        _p_text(each.scatter_p),
        since or "none",
    )
    return plain_row(*texts, mark="bad" if since else "")


def _p_text(p_value: float) -> str:
    return format_fixed(p_value, 3) if p_value >= 1e-3 else format_significant(p_value, 2)
