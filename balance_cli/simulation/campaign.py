"""Simulated campaigns: runs as they would be recorded, and the truth of each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.io.errors import UserError
from balance_cli.io.result_view import plural
from balance_cli.simulation.acquisition import RecordingSetup, record_samples, record_static, true_loads
from balance_cli.simulation.assembly import equations_of_motion
from balance_cli.simulation.channel_volts import sampled_volts
from balance_cli.simulation.load_signals import (
    CONTACT_OVERSAMPLING,
    OVERSAMPLING,
    Grid,
    attached_exciters,
    planned_loads,
    record_grid,
)
from balance_cli.simulation.motion import RigDynamics, nonlinear_forces
from balance_cli.simulation.noise import Noise
from balance_cli.simulation.plans import AnyPlan, CampaignPlan, SampledPlan, StaticPlan
from balance_cli.simulation.preset_plans import campaign_plan
from balance_cli.simulation.response import state_matrix
from balance_cli.simulation.rig import TrueRig
from balance_cli.simulation.statics import static_forces, static_load_points
from balance_cli.simulation.truth import RunTruth

Array = NDArray[np.float64]

MOST_MEMORY = 768 * 2**20
"""Bytes of the signals of one record: with the program itself a simulation then stays below 1 GB."""
LOAD_COLUMNS, COPIES_OF_VOLTS = 12, 3
"""Signals on the fine grid at once: commanded and true loads; volts, and filtering them, of each channel. With one for
each sensor it is the resident memory measured on rigs of 3 to 25 channels, to within 5 %."""


class Campaign(NamedTuple):
    """Runs and their truths, in the order of the plan."""

    runs: tuple[Run, ...]
    truths: tuple[RunTruth, ...]

    def __repr__(self) -> str:
        return f"Simulated campaign, {plural(len(self.runs), 'run')}: {', '.join(run.name for run in self.runs)}"


def _simulate_static(rig: TrueRig, plan: StaticPlan, acquisition: RecordingSetup) -> tuple[Run, RunTruth]:
    commanded_loads = static_load_points(plan)
    forces = static_forces(equations_of_motion(rig), true_loads(rig, commanded_loads, plan.kind))
    return record_static(rig, plan, commanded_loads, forces, acquisition)


def _group_by_dynamics(rig: TrueRig, plans: Sequence[SampledPlan]) -> Iterator[tuple[RigDynamics, list[SampledPlan]]]:
    """The sampled runs, grouped by equal equations of motion and sample rate."""
    groups: dict[tuple[bytes, float], tuple[RigDynamics, list[SampledPlan]]] = {}
    for plan in plans:
        mechanics = equations_of_motion(rig, plan.rotor_speed, attached_exciters(plan))
        key = (state_matrix(mechanics).tobytes(), plan.sample_rate)
        if key not in groups:
            groups[key] = (RigDynamics.from_mechanics(mechanics), [])
        groups[key][1].append(plan)
    yield from groups.values()


def _record_grids(motion: RigDynamics, plans: Sequence[SampledPlan]) -> list[Grid]:
    has_kinks = any(force.has_kinks for force in motion.mechanics.forces)
    return [record_grid(plan, CONTACT_OVERSAMPLING if has_kinks else OVERSAMPLING) for plan in plans]


def _check_memory(rig: TrueRig, motion: RigDynamics, plans: Sequence[SampledPlan], grids: Sequence[Grid]) -> None:
    """Raise UserError for the first record whose simulation would take too much memory; nothing is allocated yet."""
    columns = LOAD_COLUMNS + motion.mechanics.sensors + COPIES_OF_VOLTS * len(rig.geometry.channels)
    for plan, grid in zip(plans, grids, strict=True):
        size = 8 * columns * grid.oversampling * grid.samples
        if size > MOST_MEMORY:
            most = int(grid.samples * MOST_MEMORY / size)
            fault = f"{grid.samples} samples would take {size >> 20} MB of memory, more than {MOST_MEMORY >> 20} MB"
            remedy = f"Give at most {most} samples: a shorter record, or a lower `sample_rate`"
            raise UserError(fault, "--plan", f"run `{plan.run}`", remedy)


def _run_loads(rig: TrueRig, plan: SampledPlan, grid: Grid, acquisition: RecordingSetup) -> tuple[Array, Array]:
    """Commanded and true loads (n, 6) of a run; they are computed when needed, not stored."""
    commanded_loads = planned_loads(plan, grid, acquisition.random_stream(plan, "loads"), rig.geometry.hub)
    return commanded_loads, true_loads(rig, commanded_loads, plan.kind)


def _simulate_sampled(
    rig: TrueRig, plans: Sequence[SampledPlan], acquisition: RecordingSetup
) -> Iterator[tuple[Run, RunTruth]]:
    groups = [(motion, group, _record_grids(motion, group)) for motion, group in _group_by_dynamics(rig, plans)]
    for motion, group, grids in groups:
        _check_memory(rig, motion, group, grids)
    for motion, group, grids in groups:
        truly = (_run_loads(rig, plan, grid, acquisition)[1] for plan, grid in zip(group, grids, strict=True))
        extra = nonlinear_forces(motion, truly, grids[0].step) if motion.mechanics.forces else None
        for i, (plan, grid) in enumerate(zip(group, grids, strict=True)):
            commanded_loads, true = _run_loads(rig, plan, grid, acquisition)
            inputs = np.hstack([true, extra[i]]) if extra else true
            rng, declared = acquisition.random_stream(plan, "pickup"), rig.geometry.acquisition.filter
            volts = sampled_volts(rig, motion, inputs, grid.step, grid.oversampling, declared, rng)
            yield record_samples(rig, plan, grid, commanded_loads, volts, acquisition)


def iterate_simulated_runs(
    rig: TrueRig, plan: CampaignPlan, noise: Noise | None, seed: int = 0
) -> Iterator[tuple[Run, RunTruth]]:
    """All runs of a plan with their truths as in `simulate_campaign`, one by one, but not in the order of the plan."""
    acquisition = RecordingSetup(Noise() if noise is None else noise, seed)
    for run in plan.runs:
        if isinstance(run, StaticPlan):
            yield _simulate_static(rig, run, acquisition)
    yield from _simulate_sampled(rig, [run for run in plan.runs if not isinstance(run, StaticPlan)], acquisition)


def simulate_run(rig: TrueRig, plan: AnyPlan, noise: Noise | None = None, seed: int = 0) -> tuple[Run, RunTruth]:
    """One run and its truth, identical to that of `simulate_campaign`."""
    return next(iterate_simulated_runs(rig, CampaignPlan(runs=(plan,)), noise, seed))


def simulate_campaign(
    rig: TrueRig, plan: CampaignPlan | str = "standard", noise: Noise | None = None, seed: int = 0
) -> Campaign:
    """All runs of a plan (or of the campaign `standard` or `short`), with their truths: `runs, truths = ...`.

    The rig is in equilibrium under the first load before a record begins. Loads, noise and interference of every run
    come from independent streams of `seed`: leaving out a run changes no other run, and the noise does not change the
    loads. Raises UserError where the rig is not restrained.
    """
    if isinstance(plan, str):
        rotor = rig.geometry.rotor
        plan = campaign_plan(plan, rotor.speed) if rotor else campaign_plan(plan)
    pairs = {run.name: (run, truth) for run, truth in iterate_simulated_runs(rig, plan, noise, seed)}
    ordered = [pairs[run.run] for run in plan.runs]
    return Campaign(tuple(run for run, _ in ordered), tuple(truth for _, truth in ordered))
