"""The acquisition: from the loads and forces of a run to its record and its truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.additions import FORCE, LoadPoints, MemoryAdditions, RunAdditions
from balance_cli.campaign.recording.point_loads import with_hub_loads
from balance_cli.campaign.recording.run import MemorySource, Run, run_digest
from balance_cli.campaign.rig.channel import Channel
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.declared_values import Vector
from balance_cli.io.errors import UserError
from balance_cli.simulation.channel_volts import channel_volts
from balance_cli.simulation.filters import anti_alias
from balance_cli.simulation.load_signals import Grid, rotor_kinematics
from balance_cli.simulation.noise import Noise
from balance_cli.simulation.plans import AnyPlan, ForcePoint, RotorPlan, SampledPlan, StaticPlan, SweepPlan
from balance_cli.simulation.rig import TrueRig
from balance_cli.simulation.truth import RunTruth, random_stream

Array = NDArray[np.float64]


KINDS_WITH_LOADS = ("sweep", "check")
"""Kinds of sampled runs whose loads are recorded."""


@dataclass(frozen=True)
class RecordingSetup:
    """The noise of the acquisition, and the seed of all random numbers of the campaign."""

    noise: Noise
    seed: int

    def random_stream(self, plan: AnyPlan, what: str) -> np.random.Generator:
        """The random stream of a run for one purpose."""
        return random_stream(self.seed, plan.run, what)


def _apply_hooks(hooks: Iterable[Callable[[Array], Array]], value: Array) -> Array:
    for hook in hooks:
        value = hook(value)
    return value


def true_loads(rig: TrueRig, commanded_loads: Array, kind: str) -> Array:
    """True hub loads (n, 6) under the commanded loads (n, 6)."""
    return _apply_hooks((partial(extension.true_loads, kind=kind) for extension in rig.extensions), commanded_loads)


def _recorded_loads(rig: TrueRig, commanded_loads: Array, kind: str, step: float | None = None) -> Array:
    """Readings (n, 6) of the exciters' force cells; a component that is not applied is declared zero and stays zero."""
    recorded = _apply_hooks(
        (partial(extension.recorded_loads, kind=kind, step=step) for extension in rig.extensions), commanded_loads
    )
    applied = commanded_loads != 0 if kind == "static" else np.any(commanded_loads != 0, axis=0)
    return np.where(applied, recorded, 0.0)


def _clip_to_range(volts: Array, channels: Iterable[Channel]) -> Array:
    ranges = np.array([channel.range or np.inf for channel in channels])
    return np.clip(volts, -ranges, ranges)


def _make_run(rig: TrueRig, plan: AnyPlan, channels: Array, loads: Array | None) -> Run:
    return Run(
        name=plan.run,
        rig=rig.geometry.rig,
        kind=plan.kind,
        channel_names=rig.geometry.channel_names,
        samples=len(channels),
        source=MemorySource(channels, loads),
        has_loads=loads is not None,
        note="simulated",
        reading_units=rig.geometry.reading_units(rig.geometry.channel_names),
    )


def _add_digest(run: Run) -> Run:
    return replace(run, digest=run_digest(run))


def record_static(
    rig: TrueRig, plan: StaticPlan, commanded_loads: Array, forces: Array, acquisition: RecordingSetup
) -> tuple[Run, RunTruth]:
    """The record of a static run from commanded loads (rows, 6), cell forces and torques (rows, c+t).

    It holds the channels that measure a constant load; load components that are zero in a row are exactly zero.
    """
    noise, rng = acquisition.noise, acquisition.random_stream(plan, "noise")
    dc = [i for i, channel in enumerate(rig.geometry.channels) if channel.measures_dc]
    if not dc:
        fault = f"no channel measures the constant loads of the static run `{plan.run}`"
        raise UserError(fault, place="channels", remedy="Simulate other runs, with `--only` or a plan without this one")
    volts = channel_volts(rig, forces, None, acquisition.random_stream(plan, "pickup"))[:, dc]
    noisy = volts + noise.static_channel * rng.standard_normal(volts.shape)
    recorded = _recorded_loads(rig, commanded_loads, plan.kind)
    read = recorded + np.where(
        commanded_loads != 0, noise.static_load * rng.standard_normal(commanded_loads.shape), 0.0
    )
    clipped = _clip_to_range(noisy, [rig.geometry.channels[i] for i in dc])
    run = _make_run(rig, plan, noise.to_file_precision(clipped), noise.to_file_precision(read))
    names = tuple(rig.geometry.channel_names[i] for i in dc)
    rows = np.arange(len(commanded_loads), dtype=float)
    truth = RunTruth(plan.run, plan.kind, rows, true_loads(rig, commanded_loads, plan.kind), recorded, volts)
    return _add_digest(replace(run, channel_names=names, trim=plan.trim)), truth


def record_samples(
    rig: TrueRig, plan: SampledPlan, grid: Grid, commanded_loads: Array, volts: Array, acquisition: RecordingSetup
) -> tuple[Run, RunTruth]:
    """The record of a sampled run from commanded loads (n, 6) on the fine grid and sampled volts (n, channels)."""
    fine, stride = _recorded_loads(rig, commanded_loads, plan.kind, grid.step), grid.oversampling
    recorded = anti_alias(fine, rig.geometry.acquisition.filter, grid.step, stride)[: grid.samples]
    volts = volts[: grid.samples]
    run = read_signals(rig, plan, volts, recorded, acquisition)
    true = true_loads(rig, commanded_loads, plan.kind)[:: grid.oversampling][: grid.samples]
    truth = RunTruth(plan.run, plan.kind, grid.time, true, recorded, volts)
    run, truth = _add_plan_metadata(run, truth, plan)
    return _add_digest(run), truth


def sweep_record(rig: TrueRig, plan: SweepPlan, volts: Array, recorded: Array, acquisition: RecordingSetup) -> Run:
    """The record of a sweep whose volts (n, c) and loads (n, 6) without noise are known."""
    run = read_signals(rig, plan, volts, recorded, acquisition)
    return _add_digest(
        _add_sweep_metadata(replace(run, sample_rate=plan.sample_rate, rotor_speed=plan.rotor_speed), plan)
    )


def read_signals(rig: TrueRig, plan: SampledPlan, volts: Array, recorded: Array, acquisition: RecordingSetup) -> Run:
    """The run that reads these volts (n, c) and loads (n, 6) with noise; without metadata and digest."""
    geometry, noise, rng = rig.geometry, acquisition.noise, acquisition.random_stream(plan, "noise")
    sigma = np.array([noise.sigma_of_channel(channel) for channel in geometry.channels])
    noisy = volts + sigma * rng.standard_normal(volts.shape)
    applied = np.any(recorded != 0, axis=0)
    read = recorded + np.where(applied, noise.load * rng.standard_normal(recorded.shape), 0.0)
    converted = noise.to_file_precision(noise.quantize(_clip_to_range(noisy, geometry.channels)))
    if isinstance(plan, SweepPlan) and plan.point is not None:
        force = noise.to_file_precision(_force_at_point(plan.point, recorded, geometry.hub, noise.load, rng))
        return _run_with_point(rig, plan, converted, plan.point, force)
    has_loads = plan.kind in KINDS_WITH_LOADS
    return _make_run(rig, plan, converted, noise.to_file_precision(read) if has_loads else None)


def _force_at_point(point: ForcePoint, loads: Array, hub: Vector, noise: float, rng: np.random.Generator) -> Array:
    """The reading (n, 1) of the force cell at a point, from the hub loads (n, 6) that it makes."""
    wrench = point.wrench(hub)
    column = COMPONENTS.index(point.component)
    return np.asarray(loads[:, [column]] / wrench[column] + noise * rng.standard_normal((len(loads), 1)))


def _run_with_point(rig: TrueRig, plan: SweepPlan, channels: Array, point: ForcePoint, force: Array) -> Run:
    """A run whose loads are the `force` (n, 1) at a point."""
    places = LoadPoints((point.name,), np.array([point.direction]), np.array([point.position]))
    additions = RunAdditions(places, source=MemoryAdditions({FORCE: force}))
    return with_hub_loads(replace(_make_run(rig, plan, channels, None), additions=additions), rig.geometry)


def _add_sweep_metadata(run: Run, plan: SweepPlan) -> Run:
    period = plan.period if plan.excitation in ("multisine", "sine-sweep") else None
    return replace(run, excited=plan.excited, excitation=plan.excitation, level=plan.level, period=period)


def _add_plan_metadata(run: Run, truth: RunTruth, plan: SampledPlan) -> tuple[Run, RunTruth]:
    """Run and truth with the plan's metadata of excitation or rotor."""
    run = replace(run, sample_rate=plan.sample_rate, rotor_speed=plan.rotor_speed)
    if isinstance(plan, SweepPlan):
        run = _add_sweep_metadata(run, plan)
    if isinstance(plan, RotorPlan):
        rotor = rotor_kinematics(plan)
        pulses = rotor.pulse_times(plan.duration)
        truth = replace(truth, azimuth=rotor.azimuth(truth.time))
        cosine, sine = truth.harmonics(pulses[0], pulses[-1])
        run = replace(run, pulse_times=pulses) if plan.pulses else replace(run, rotor_speed=0.0)
        return run, replace(truth, cosine=cosine, sine=sine)
    return run, truth
