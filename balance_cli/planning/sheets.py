"""A sheet for each run of a plan, in Markdown, for the people in the hall."""

from __future__ import annotations

from collections.abc import Iterator

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.planning.result import PlannedCampaign
from balance_cli.simulation.plans import SweepPlan

UNITS = dict(zip(COMPONENTS, ("N", "N", "N", "N m", "N m", "N m"), strict=True))


def sheets_text(planned: PlannedCampaign) -> str:
    """All sheets: a table of the runs, then one page for each."""
    return "\n".join([*_overview(planned), *(line for i in range(len(planned.chosen)) for line in _sheet(planned, i))])


def _overview(planned: PlannedCampaign) -> Iterator[str]:
    yield f"# Plan for {planned.rig}"
    yield ""
    yield f"{len(planned.chosen)} runs, {planned.minutes:.0f} minutes with changes of set-up."
    yield ""
    yield "| run | excited | rotor | record | done |"
    yield "|---|---|---|---|---|"
    for item in planned.chosen:
        plan = item.plan
        yield f"| {plan.run} | {', '.join(plan.excited)} | {_rotor(plan)} | {plan.duration:.0f} s | |"
    yield ""


def _sheet(planned: PlannedCampaign, index: int) -> Iterator[str]:
    plan = planned.chosen[index].plan
    before = planned.chosen[index - 1] if index else None
    yield f"## Run {plan.run}"
    yield ""
    if before is None or before.setup != planned.chosen[index].setup:
        yield f"**Change of set-up:** exciters on {', '.join(plan.excited)}; rotor {_rotor(plan)}."
        yield ""
    yield "| setting | value |"
    yield "|---|---|"
    for name, level in zip(plan.excited, plan.level, strict=True):
        yield f"| level of {name} | {level:.4g} {UNITS[name]} rms |"
    yield f"| excitation | {plan.excitation}, {plan.band[0]:.4g} to {plan.band[1]:.4g} Hz |"
    if plan.phases == "schroeder":
        yield "| phases | of line k = 1, 2 ... K (equal amplitudes, cosines): -180 k (k - 1) / K degrees |"
    yield f"| period | {plan.period:.6g} s, {plan.periods} times: {plan.duration:.1f} s |"
    yield f"| sample rate | {plan.sample_rate:g} Hz |"
    yield f"| rotor | {_rotor(plan)} |"
    yield ""
    yield "Before: no channel clips at this level; zero record made; time of day: ________"
    yield ""
    yield "After: record kept as ________________ ; remarks: ________________________________"
    yield ""


def _rotor(plan: SweepPlan) -> str:
    return f"turning at {plan.rotor_speed:g} Hz" if plan.rotor_speed else "at rest"
