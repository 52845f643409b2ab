"""The settings of a planned run in words, for sheets, terminal and page."""

from __future__ import annotations

from balance_cli.campaign.rig.components import UNIT_OF
from balance_cli.simulation.plans import AnyPlan, StaticPlan, SweepPlan
from balance_cli.simulation.statics import static_load_points


def excitation_words(plan: AnyPlan) -> str:
    """What drives the rig: components, or a point."""
    if isinstance(plan, StaticPlan):
        return "weights"
    if not isinstance(plan, SweepPlan):
        return plan.kind
    if plan.point is not None:
        return f"{'hammer' if plan.excitation == 'impact' else 'force'} at {plan.point.name}"
    return ", ".join(plan.excited)


def level_words(plan: AnyPlan) -> str:
    """The rms level of each component, or the largest static loads."""
    if isinstance(plan, StaticPlan):
        return ", ".join(f"{name} {value:.3g} {UNIT_OF[name]}" for name, value in plan.largest.items())
    if not isinstance(plan, SweepPlan):
        return ""
    return ", ".join(f"{value:.3g} {UNIT_OF[name]}" for name, value in zip(plan.excited, plan.level, strict=True))


def condition_words(plan: AnyPlan) -> str:
    """Rotor and mean loads."""
    if isinstance(plan, StaticPlan):
        return f"at rest, trim {plan.trim}"
    rotor = f"turning at {plan.rotor_speed:g} Hz" if plan.rotor_speed else "at rest"
    steady = plan.steady if isinstance(plan, SweepPlan) else None
    loads = ", ".join(f"{name} {value:g} {UNIT_OF[name]}" for name, value in (steady or {}).items())
    return f"{rotor}, under {loads}" if loads else rotor


def record_words(plan: AnyPlan) -> str:
    """Length of a record, or number of load points."""
    if isinstance(plan, StaticPlan):
        return f"{len(static_load_points(plan))} points"
    return f"{plan.duration:.0f} s"
