"""Simulated campaigns: runs as they would be recorded, and the truth behind each."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from balance_cli.runs import Run
from balance_cli.simulation.acquisition import Acquisition, record_samples, record_static, true_loads
from balance_cli.simulation.mechanics import equations_of_motion
from balance_cli.simulation.noise import Noise
from balance_cli.simulation.plans import AnyPlan, CampaignPlan, SampledPlan, StaticPlan, campaign_plan
from balance_cli.simulation.records import planned_record
from balance_cli.simulation.response import linear_system
from balance_cli.simulation.rig import TrueRig
from balance_cli.simulation.statics import loading_sequence, static_forces
from balance_cli.simulation.truth import RunTruth

Array = NDArray[np.float64]


class Campaign(NamedTuple):
    """Runs and their truths, in the order of the plan."""

    runs: tuple[Run, ...]
    truths: tuple[RunTruth, ...]


def _static(rig: TrueRig, plan: StaticPlan, acquisition: Acquisition) -> tuple[Run, RunTruth]:
    meant = loading_sequence(plan)
    forces = static_forces(equations_of_motion(rig), true_loads(rig, meant, plan.kind))
    return record_static(rig, plan, meant, forces, acquisition)


def _sampled(rig: TrueRig, plan: SampledPlan, acquisition: Acquisition) -> tuple[Run, RunTruth]:
    grid, meant = planned_record(plan, acquisition.stream(plan, "loads"))
    system = linear_system(equations_of_motion(rig, plan.rotor_speed))
    forces = system.response(true_loads(rig, meant, plan.kind), grid.step)
    return record_samples(rig, plan, grid, meant, forces, acquisition)


def simulate_run(rig: TrueRig, plan: AnyPlan, noise: Noise | None = None, seed: int = 0) -> tuple[Run, RunTruth]:
    """One run and its truth. The same rig, plan, noise and seed give the same run, whatever else is simulated.

    The rig stands in equilibrium under the first load before the record begins. Raises UserError where the rig
    cannot stand still.
    """
    acquisition = Acquisition(Noise() if noise is None else noise, seed)
    if isinstance(plan, StaticPlan):
        return _static(rig, plan, acquisition)
    return _sampled(rig, plan, acquisition)


def simulate_campaign(
    rig: TrueRig, plan: CampaignPlan | str = "standard", noise: Noise | None = None, seed: int = 0
) -> Campaign:
    """All runs of a plan (or of the campaign `standard` or `short`), with their truths: `runs, truths = ...`.

    Loads, noise and pickup of every run come from independent streams of `seed`: leaving a run out changes no other,
    nor does the noise change the loads. Raises UserError as `simulate_run`.
    """
    if isinstance(plan, str):
        rotor = rig.geometry.rotor
        plan = campaign_plan(plan, rotor.speed) if rotor else campaign_plan(plan)
    pairs = [simulate_run(rig, one, noise, seed) for one in plan.runs]
    return Campaign(tuple(run for run, _ in pairs), tuple(truth for _, truth in pairs))
