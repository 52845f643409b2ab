"""A sheet for each run of a plan, in Markdown, for the people in the hall."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from balance_cli.campaign.rig.components import UNIT_OF
from balance_cli.planning.result import PlannedCampaign
from balance_cli.planning.run_words import condition_words, excitation_words, record_words
from balance_cli.simulation.load_signals import sweep_lines
from balance_cli.simulation.plans import StaticPlan, SweepPlan


def sheets_text(planned: PlannedCampaign) -> str:
    """All sheets: a table of the runs, then one page for each."""
    return "\n".join([*_overview(planned), *(line for i in range(len(planned.chosen)) for line in _sheet(planned, i))])


def _overview(planned: PlannedCampaign) -> Iterator[str]:
    yield f"# Plan for {planned.rig}"
    yield ""
    yield f"{len(planned.chosen)} runs, {planned.minutes:.0f} minutes with changes of set-up."
    yield ""
    yield "| run | excited | rotor, loads | record | done |"
    yield "|---|---|---|---|---|"
    for item in planned.chosen:
        plan = item.plan
        yield f"| {plan.run} | {excitation_words(plan)} | {condition_words(plan)} | {record_words(plan)} | |"
    yield ""


def _sheet(planned: PlannedCampaign, index: int) -> Iterator[str]:
    plan = planned.chosen[index].plan
    before = planned.chosen[index - 1] if index else None
    yield f"## Run {plan.run}"
    yield ""
    if before is None or before.setup != planned.chosen[index].setup:
        yield f"**Change of set-up:** {excitation_words(plan)}; rotor {condition_words(plan)}."
        yield ""
    yield "| setting | value |"
    yield "|---|---|"
    yield from _static_settings(plan) if isinstance(plan, StaticPlan) else _sweep_settings(plan)
    yield f"| rotor, loads | {condition_words(plan)} |"
    yield ""
    yield "Before: no channel clips at this level; zero record made; time of day: ________"
    yield ""
    yield "After: record kept as ________________ ; remarks: ________________________________"
    yield ""


def _static_settings(plan: StaticPlan) -> Iterator[str]:
    for name, largest in plan.largest.items():
        yield f"| largest {name} | {largest:.4g} {UNIT_OF[name]}, in {plan.steps} steps up and down, both signs |"
    yield f"| load points | {record_words(plan)}, in the order of the plan |"


def _sweep_settings(plan: SweepPlan) -> Iterator[str]:
    for name, level in zip(plan.excited, plan.level, strict=True):
        label = f"level of {name}" if plan.point is None else "level of the force"
        yield f"| {label} | {level:.4g} {UNIT_OF[name]} rms |"
    if plan.point is not None:
        position, direction = (_vector(each) for each in (plan.point.position, plan.point.direction))
        yield f"| point {plan.point.name} | at {position} m, direction {direction} |"
    if plan.contact is not None:
        yield f"| hits | {plan.periods}, of {1e3 * plan.contact:.3g} ms, one in {plan.period:.4g} s |"
    else:
        yield f"| excitation | {plan.excitation}, {plan.band[0]:.4g} to {plan.band[1]:.4g} Hz |"
        yield f"| period | {plan.period:.6g} s, {plan.periods} times: {plan.duration:.1f} s |"
    if plan.excitation == "multisine" and plan.phases != "random":
        yield f"| lines | amplitudes and phases: `plan --lines`; peak {_crest_factor(plan):.2f} times the rms |"
    yield f"| sample rate | {plan.sample_rate:g} Hz |"


def _vector(values: tuple[float, float, float]) -> str:
    return ", ".join(f"{x:g}" for x in values)


def _crest_factor(plan: SweepPlan) -> float:
    """The largest of the components."""
    rng = np.random.default_rng(0)  # not used by fixed phases
    return max(sweep_lines(plan, index, rng).crest_factor for index in range(len(plan.excited)))


def lines_table(planned: PlannedCampaign) -> str:
    """Lines of all multisines with fixed phases, as CSV: run, component, frequency, amplitude and phase of a cosine."""
    rows = ["run,component,frequency_hz,amplitude,phase_deg"]
    rng = np.random.default_rng(0)  # not used by fixed phases
    for item in planned.chosen:
        plan = item.plan
        if not isinstance(plan, SweepPlan) or plan.excitation != "multisine" or plan.phases == "random":
            continue
        for index, name in enumerate(plan.excited):
            lines = sweep_lines(plan, index, rng)
            phase = np.degrees(np.angle(np.exp(1j * lines.phase)))
            values = zip(lines.frequency, lines.amplitude, phase, strict=True)
            rows += [f"{plan.run},{name},{f:.9g},{a:.6g},{p:.4f}" for f, a, p in values]
    return "\n".join(rows) + "\n"
