"""Planned against achieved runs as JSON keys for scripts, and as text for the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from balance_cli.planning.comparison import PlanComparison


def comparison_summary(comparison: PlanComparison) -> dict[str, Any]:
    """Return the JSON keys of docs/json.md."""
    return {
        "compared": [asdict(run) for run in comparison.runs],
        "not_made": comparison.not_made,
        "not_planned": comparison.not_planned,
        "sizes": [asdict(item) for item in comparison.sizes],
    }


def comparison_text(comparison: PlanComparison) -> Iterator[str]:
    """Yield the lines of the console summary."""
    yield "Achieved over planned:"
    yield f"   {'run':<28} information   level   noise  steady time"
    for run in comparison.runs:
        ratios = (run.information_ratio, run.level_ratio, run.noise_ratio, run.time_ratio)
        yield f"   {run.run:<28} {_ratio(ratios[0]):>11} {' '.join(f'{_ratio(r):>7}' for r in ratios[1:])}"
        if run.causes:
            yield f"      not as planned: {'; '.join(run.causes)}"
    if comparison.not_made:
        yield f"not made: {', '.join(comparison.not_made)}"
    if comparison.not_planned:
        yield f"not in the plan: {', '.join(comparison.not_planned)}"
    yield "Smallest size that is found, by the runs that were made:"
    yield f"   {'effect, hardest place':<52} {'planned':>10} {'achieved':>10} unit"
    for item in comparison.sizes:
        sizes = f"{item.planned:>10.3g} {item.achieved:>10.3g}"
        yield f"   {item.label + ' ' + item.parameter:<52} {sizes} {item.unit}"


def _ratio(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else "-"
