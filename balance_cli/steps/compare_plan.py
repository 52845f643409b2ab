"""Compare the runs of a campaign with its plan, run by run."""

from __future__ import annotations

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.io.errors import UserError
from balance_cli.planning.channel_noise import planning_noise
from balance_cli.planning.comparison import ExecutedRun, PlanComparison, compare_run, compare_sizes
from balance_cli.planning.information import (
    RunInformation,
    add_information,
    mean_information,
    spectra_information,
)
from balance_cli.planning.rehearsal import rehearse
from balance_cli.simulation.noise import DeclaredNoise
from balance_cli.simulation.plans import CampaignPlan, SweepPlan
from balance_cli.steps.plan import REHEARSALS, PlanningRig, PlanOptions, planning_rig


def compare_plan(
    geometry: Geometry,
    plan: CampaignPlan,
    options: PlanOptions,
    spectra: Spectra,
    model: IdentifiedModel | None = None,
) -> PlanComparison:
    """Compare the sweeps of a plan with the runs of these names; without a model the runs are identified.

    What was planned is rehearsed with the rig as it is known now and the noise that the plan keeps, so that a
    difference is one of how the runs were made. Raises UserError where no run of the plan was made.
    """
    base = planning_rig(geometry, options.hall, model, spectra)
    lines = {run.run: run for run in spectra.lines}
    planned = [run for run in plan.runs if isinstance(run, SweepPlan)]
    executed_plans = [run for run in planned if run.run in lines]
    if not executed_plans:
        names = ", ".join(run.run for run in planned[:5])
        raise UserError("no run has the name of a planned sweep", "RUN...", remedy=f"Give the runs of {names} ...")
    achieved = {run.run: run for run in spectra_information(spectra, base.model)}
    declared = plan.noise or options.hall.noise
    executed = [_rehearsed(run, spectra, achieved[run.run], base, declared, options.seed) for run in executed_plans]
    names_of_plan = {run.run for run in plan.runs}
    others = [name for name in achieved if name not in names_of_plan]
    before = add_information([achieved[name] for name in others], base.model)
    campaign = np.diag(sum(run.planned.information for run in executed))
    return PlanComparison(
        runs=tuple(compare_run(run, campaign) for run in executed),
        not_made=tuple(run.run for run in planned if run.run not in lines),
        not_planned=tuple(others),
        sizes=compare_sizes(before, executed, base.model, options.detection),
    )


def _rehearsed(
    plan: SweepPlan,
    spectra: Spectra,
    achieved: RunInformation,
    base: PlanningRig,
    declared: DeclaredNoise | None,
    seed: int,
) -> ExecutedRun:
    noise = planning_noise(declared, (), plan.sample_rate)
    records = [rehearse(plan, base.signals, noise, seed + k) for k in range(REHEARSALS)]
    parts = [spectra_information(each, base.model)[0] for each in records]
    planned = mean_information(parts, plan.run)
    lines = next(run for run in spectra.lines if run.run == plan.run)
    return ExecutedRun(plan, lines, records[0].lines[0], achieved, planned)
