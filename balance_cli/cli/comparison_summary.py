"""Text and JSON of `balance calibrate --against`: what changed since an earlier calibration."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from balance_cli.calibration.comparison import SIGNIFICANCE_LEVEL, CalibrationComparison, TermChange
from balance_cli.io.units import NUMBER

MOST_LINES = 12
"""Changes listed in the text; the JSON has them all."""


def comparison_summary(comparison: CalibrationComparison, name: str) -> dict[str, Any]:
    """The comparison for JSON."""
    return {
        "calibration": name,
        "significance_level": SIGNIFICANCE_LEVEL,
        "changed": len(comparison.significant),
        "coefficients": [
            {
                "channel": change.channel,
                "term": change.term,
                "unit": change.unit,
                "old": change.old,
                "new": change.new,
                "sigma": change.sigma,
                "t": change.t,
                "p": change.p_value,
                "significant": bool(change.is_significant),
            }
            for change in comparison.changes
        ],
        "load_change_percent_fs": comparison.load_change,
        "channels_left_out": comparison.channels_left_out,
    }


def comparison_text(comparison: CalibrationComparison, name: str) -> Iterator[str]:
    """Lines of text: how many coefficients changed, which, and what that is worth in loads."""
    changed = comparison.significant
    yield (
        f"Against {name}: {len(changed)} of {len(comparison.changes)} coefficients changed significantly "
        f"(p below {SIGNIFICANCE_LEVEL:g} for any of them)"
    )
    for change in changed[:MOST_LINES]:
        yield f"  {_change_text(change)}"
    if len(changed) > MOST_LINES:
        yield f"  and {len(changed) - MOST_LINES} more"
    if comparison.load_change:
        worth = ", ".join(f"{component} {value:+.3g}" for component, value in comparison.load_change.items())
        yield f"  largest error of loads by the older calibration, one load at its calibrated range, % FS: {worth}"


def _change_text(change: TermChange) -> str:
    old, new = (_coefficient_text(value, change.unit) for value in (change.old, change.new))
    share = f" ({100 * (change.new / change.old - 1):+.3g} %)" if change.old and change.new else ""
    return f"{change.channel} {change.term}: {old} -> {new} at calibrated range{share}, t {change.t:.1f}"


def _coefficient_text(value: float, unit: str) -> str:
    """A coefficient in millionths of its unit, counts as they are."""
    return f"{value:.6g}" if unit == NUMBER else f"{1e6 * value:.6g} u{unit}"
