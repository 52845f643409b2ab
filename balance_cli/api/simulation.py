"""Simulated campaigns with known truth."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from balance_cli.api.arguments import Range, check_arguments
from balance_cli.api.inputs import GeometryLike, PathLike, to_geometry
from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.simulation import (
    Campaign,
    CampaignPlan,
    Noise,
    campaign_plan,
    draw_rig,
    simulate_campaign,
    true_rig,
)
from balance_cli.simulation.files import read_plan
from balance_cli.simulation.noise import LARGEST_NOISE
from balance_cli.simulation.preset_plans import PRESETS
from balance_cli.simulation.rig import apply_effects
from balance_cli.simulation.truth import random_stream

DEFAULT_ROTOR_SPEED = 17.5
"""Rotor speed [Hz] of a plan where the geometry declares none: that of the sample campaign."""


@check_arguments
def simulate(
    geometry: GeometryLike,
    plan: str | PathLike | CampaignPlan | Mapping[str, Any] = "standard",
    *,
    effects: Iterable[DeclaredEffect | Mapping[str, Any]] = (),
    sample_tolerances: bool = False,
    noise: Annotated[float, Range(0.0, LARGEST_NOISE)] = 1.0,
    seed: Annotated[int, Range(0)] = 0,
) -> Campaign:
    """Simulate a campaign in the time domain, as `balance simulate` does; returns `runs` and their `truths`.

    `plan` is `standard`, `short`, a YAML file, or its content. Each of `effects` is written as in a geometry file:
    `{"name": ..., "where": [...], "parameters": {...}}`. The rig is as declared, or with `sample_tolerances` drawn from
    the tolerances. `noise` multiplies that of the recorded campaign; 0 leaves rounding out, too.

    >>> import balance_cli as bal
    >>> plan = {"runs": [{"run": "static", "kind": "static", "largest": {"Fz": 1000.0}, "steps": 3}]}
    >>> delay = {"name": "time-delay", "where": ["x.piezo"], "parameters": {"delay": 6e-4}}
    >>> campaign = bal.simulate("configs/rts-6.yaml", plan, effects=[delay], seed=1)
    >>> campaign
    Simulated campaign, 1 run: static
    >>> campaign.truths[0].loads.shape
    (13, 6)
    """
    declared = to_geometry(geometry)
    added = [DeclaredEffect.model_validate(effect) for effect in effects]
    rig = draw_rig(declared, random_stream(seed, "", "rig")) if sample_tolerances else true_rig(declared)
    rig = apply_effects(rig, (*declared.effects, *added))
    speed = declared.rotor.speed if declared.rotor else DEFAULT_ROTOR_SPEED
    return simulate_campaign(rig, _to_plan(plan, speed), replace(Noise(), single_precision=True).scale_by(noise), seed)


def _to_plan(plan: str | PathLike | CampaignPlan | Mapping[str, Any], rotor_speed: float) -> CampaignPlan:
    if isinstance(plan, CampaignPlan):
        return plan
    if isinstance(plan, Mapping):
        return CampaignPlan.model_validate(plan)
    return campaign_plan(plan, rotor_speed) if isinstance(plan, str) and plan in PRESETS else read_plan(Path(plan))
