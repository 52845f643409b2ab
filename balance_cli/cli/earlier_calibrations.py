"""`balance calibrate --against`: what changed since earlier calibrations, and the control chart over all of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from balance_cli.cli.common import Session
from balance_cli.io.errors import UserError
from balance_cli.io.formats import CALIBRATION_FORMAT

if TYPE_CHECKING:
    from balance_cli.calibration.control_chart import CoefficientHistory, ControlChart
    from balance_cli.calibration.result import Calibration

MOST_LINES = 8
"""Coefficients of the control chart listed in the text; the JSON has them all."""


def compare_with_earlier(
    session: Session, result: Calibration, paths: Sequence[Path], name: str, text: list[str]
) -> dict[str, Any]:
    """Compare with the latest of earlier calibrations, and with all of them; adds to the text, returns the summary.

    It is called after the result was staged, which does not depend on what it is compared with.
    """
    from balance_cli.calibration.comparison import compare_calibrations
    from balance_cli.calibration.control_chart import MIN_CALIBRATIONS, control_chart
    from balance_cli.calibration.result import Calibration
    from balance_cli.cli.comparison_summary import comparison_summary, comparison_text

    twice = next((path for number, path in enumerate(paths) if path in paths[:number]), None)
    if twice is not None:
        raise UserError("is given twice", str(twice), "--against", "Give each calibration once, the oldest first")
    earlier = []
    for path in paths:
        old = session.artefact(path, {CALIBRATION_FORMAT: Calibration}, "calibration").content
        try:
            earlier.append((path.name, old, compare_calibrations(result, old)))
        except UserError as error:
            raise error.with_location(file=str(path)) from None
    latest, _, comparison = earlier[-1]
    text += comparison_text(comparison, latest)
    summary: dict[str, Any] = {"against": comparison_summary(comparison, latest), "control_chart": None}
    if len(earlier) + 1 >= MIN_CALIBRATIONS:
        chart = control_chart([*((file, old) for file, old, _ in earlier), (name, result)])
        text += _chart_text(chart)
        summary["control_chart"] = _chart_summary(chart)
    return summary


def _chart_summary(chart: ControlChart) -> dict[str, Any]:
    from balance_cli.calibration.control_chart import LIMIT_P_VALUE, SIGNIFICANCE_LEVEL, chart_rows

    return {
        "calibrations": chart.names,
        "significance_level": SIGNIFICANCE_LEVEL,
        "limit_p": LIMIT_P_VALUE,
        "drifting": len(chart.drifting_coefficients),
        "scattering": len(chart.scattering_coefficients),
        "out_of_control": len(chart.out_of_control),
        "gain_trends": [vars(trend) for trend in chart.gain_trends],
        "coefficients": list(chart_rows(chart)),
    }


def _chart_text(chart: ControlChart) -> Iterator[str]:
    drifting, scattering = chart.drifting_coefficients, chart.scattering_coefficients
    outside = chart.out_of_control
    yield (
        f"Control chart of {len(chart.names)} calibrations, the oldest first: {len(drifting)} of "
        f"{len(chart.coefficients)} coefficients drift, {len(scattering)} differ by more than their errors, "
        f"{len(outside)} of the newest are beyond their limits"
    )
    yield from (f"  {trend.sentence}" for trend in chart.gain_trends)
    named = tuple(dict.fromkeys((*outside, *drifting, *scattering)))
    for each in named[:MOST_LINES]:
        yield f"  {_history_text(each)}"
    if len(named) > MOST_LINES:
        yield f"  and {len(named) - MOST_LINES} more"


def _history_text(each: CoefficientHistory) -> str:
    words = f"{each.channel} {each.term}: newest {_percent(each, each.values[-1] - each.mean)} from the mean of all"
    if each.is_out_of_control:
        limits = " to ".join(_percent(each, limit - each.mean) for limit in (each.low, each.high))
        words += f", limits {limits}"
    return f"{words}; drift {_percent(each, each.drift)} a calibration (p {each.drift_p:.2g})"


def _percent(each: CoefficientHistory, value: float) -> str:
    return f"{100.0 * value / abs(each.mean):+.3g} %" if each.mean else f"{value:+.3g} {each.unit}"
