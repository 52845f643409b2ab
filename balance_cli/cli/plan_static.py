"""`balance plan --points`: a static schedule, as a plan of `simulate`, as JSON keys and as text."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from balance_cli.cli.common import Session
from balance_cli.io.errors import UserError
from balance_cli.planning.choices import TermSet

if TYPE_CHECKING:
    from balance_cli.planning.static_schedule import ScheduleDesign, StaticSchedule
    from balance_cli.simulation.plans import Component

SAVED_DIGITS = 6
"""Significant digits of a load in the plan: a weight is known to fewer."""


def plan_static(
    session: Session, geometry: Path, hall: Path | None, points: int, terms: TermSet, together: int, output: Path | None
) -> None:
    """Plan a static schedule, write it and report."""
    from balance_cli.planning.static_schedule import plan_static_schedule

    assert output is not None
    largest = _largest_loads(session, geometry, hall)
    schedule = plan_static_schedule(tuple(largest), tuple(largest.values()), points, terms, together)
    session.write_text(output, _file_text(schedule))
    session.finish(_summary(schedule), _text(schedule))


def _largest_loads(session: Session, geometry: Path, hall: Path | None) -> Mapping[Component, float]:
    """The largest loads. Raises UserError where neither states any, or the balance does not measure one of them."""
    from balance_cli.campaign.rig.load_components import load_components
    from balance_cli.planning.hall import static_load_limits
    from balance_cli.planning.hall_file import load_hall

    rig = session.geometry(geometry, mechanics=False)
    try:
        largest = static_load_limits(rig, load_hall(hall) if hall is not None else None)
        components = load_components(rig)
        unmeasured = [name for name in largest if components.are_hub_loads and name not in components.names]
        if unmeasured:
            remedy = f"Give loads of {', '.join(components.names)}"
            raise UserError(f"this balance does not measure {unmeasured[0]}", place="static_loads", remedy=remedy)
        return largest
    except UserError as error:
        raise error.with_location(str(hall or geometry)) from error


def _file_text(schedule: StaticSchedule) -> str:
    import yaml

    points = [
        {
            name: float(f"{share * largest:.{SAVED_DIGITS}g}")
            for name, largest, share in zip(schedule.components, schedule.largest, row, strict=True)
            if share
        }
        for row in schedule.optimal.points.tolist()
    ]
    plan = {"runs": [{"run": "static-optimal", "kind": "static", "points": points}]}
    return yaml.safe_dump(plan, sort_keys=False, default_flow_style=None, width=120)


def _summary(schedule: StaticSchedule) -> dict[str, Any]:
    """The JSON keys of docs/json.md."""
    return {
        "points": len(schedule.optimal.points),
        "efficiency": schedule.efficiency,
        "optimal": _design_summary(schedule, schedule.optimal),
        "one_at_a_time": _design_summary(schedule, schedule.one_at_a_time),
    }


def _design_summary(schedule: StaticSchedule, design: ScheduleDesign) -> dict[str, Any]:
    sigma = dict(zip(schedule.terms, design.sigma.tolist(), strict=True))
    return {
        "term_sigma": {name: value if math.isfinite(value) else None for name, value in sigma.items()},
        "aliased": [{"name": name, "why": why} for name, why in design.aliased.items()],
    }


def _text(schedule: StaticSchedule) -> Iterator[str]:
    count = len(schedule.optimal.points)
    yield f"{count} load points for {len(schedule.terms)} terms, D-optimal beside one load at a time:"
    for label, design in (("D-optimal", schedule.optimal), ("one at a time", schedule.one_at_a_time)):
        determined = len(schedule.terms) - len(design.aliased)
        yield f"   {label:<14} {determined} terms determined, median sigma {design.median_sigma:.3g} of one reading"
        if design.aliased:
            yield f"      not determined: {', '.join(design.aliased)}"
    yield f"   for the terms of both, one load at a time needs {schedule.efficiency:.2f} times as many points"
