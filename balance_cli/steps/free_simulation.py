"""Free simulation of an updated model: its channels under the recorded loads alone, integrated in time.

A nonlinear force is computed from the channels that it is to explain, so that a strong enough one explains any
measurement by itself. An integration of the same rig in time, by code that shares nothing with the estimator and sees
the loads only, shows whether it does so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.channel_health import live_channels
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.diagnosis.hold_out_settings import FreeSimulationSettings
from balance_cli.diagnosis.result import Diagnosis, Trial
from balance_cli.diagnosis.search.trials import last_round, refit_trial
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS, SearchSettings
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.model.balance import balance_model
from balance_cli.model.placed_effects import declared_effects, effect_label
from balance_cli.simulation.extensions.library import EXTENSIONS
from balance_cli.simulation.replay import replay_loads
from balance_cli.simulation.rig import TrueRig, apply_effects, true_rig
from balance_cli.steps.identify import IdentifyOptions, identify

Array = NDArray[np.float64]
Diagnose = Callable[..., tuple[Diagnosis, IdentifiedModel]]

REASON = "a simulation by the loads alone is worse with it"


# ---- one model and one run -------------------------------------------------------------------------------------------


def simulation_error(run: Run, model: IdentifiedModel, settings: FreeSimulationSettings) -> float:
    """Return the relative rms error of the simulated channels of a run; infinite where the simulation diverges.

    Only the second half of the simulated samples counts, after the start of the record has decayed; means do not. NaN
    where the model has an effect that the simulation lacks.
    """
    rig = simulated_rig(model)
    if rig is None or not run.sample_rate:
        return float("nan")
    block = run.read(0, min(run.samples, settings.max_samples))
    assert block.loads is not None
    try:
        volts = replay_loads(rig, block.loads, run.kind, run.sample_rate, run.rotor_speed or 0.0)
    except (np.linalg.LinAlgError, FloatingPointError):
        return float("inf")
    live = live_channels(run, model.geometry).live
    half = slice(len(volts) // 2, None)
    measured = block.channels[half][:, [run.channel_names.index(name) for name in live]]
    simulated = volts[half][:, [model.geometry.channel_names.index(name) for name in live]]
    measured, simulated = (signals - signals.mean(axis=0) for signals in (measured, simulated))
    error = float(np.linalg.norm(simulated - measured) / np.linalg.norm(measured))
    return error if np.isfinite(error) else float("inf")


def simulated_rig(model: IdentifiedModel) -> TrueRig | None:
    """Return the rig of an identified model for the simulation; None where that lacks one of its effects."""
    geometry, value = model.geometry, dict(zip(model.parameters.names, model.parameters.value.tolist(), strict=True))
    # A tone has another phase in each run, and no load causes it.
    tones = {item.effect.name for item in declared_effects(geometry) if item.effect.search.tone is not None}
    effects = [item for item in geometry.effects if item.name not in tones]
    if model.form != "physical" or any(item.name not in EXTENSIONS for item in effects):
        return None
    stiffness, inertia, damping_ratio = (
        [value[f"{meter.parameter}.{name}"] for meter in geometry.shaft_meters] or None
        for name in ("stiffness", "inertia", "damping_ratio")
    )
    rig = true_rig(
        geometry,
        mass=value["mass"],
        cg=[value[f"centre_of_gravity.{axis}"] for axis in "xyz"],
        inertia=_inertia_tensor(value),
        stiffness=[value[f"stiffness.{name}"] for name in geometry.cell_names],
        damping_ratios=[value[f"damping_ratio.{i + 1}"] for i in range(len(geometry.freedom))],
        sensitivities=[value[f"sensitivity.{name}"] for name in geometry.channel_names],
        torque_stiffness=stiffness,
        torque_inertia=inertia,
        torque_damping_ratio=damping_ratio,
    )
    return apply_effects(rig, effects)


def _inertia_tensor(value: dict[str, float]) -> Array:
    """The tensor (3, 3), whose products are minus the declared ones."""
    tensor = np.diag([value[f"inertia.{axis}{axis}"] for axis in "xyz"])
    for i, j in ((0, 1), (0, 2), (1, 2)):
        tensor[i, j] = tensor[j, i] = -value[f"inertia.{'xyz'[i]}{'xyz'[j]}"]
    return tensor


# ---- nonlinear effects that explain themselves -----------------------------------------------------------------------


@dataclass(frozen=True)
class SimulationTask:
    """What a diagnosis is tested with: the start model, the spectra of the fitted runs, and all runs with loads."""

    model: IdentifiedModel
    spectra: Spectra
    fitted: Sequence[Run]
    hold_out: Sequence[Run]


def diagnose_with_free_simulation(
    task: SimulationTask, diagnose: Diagnose, settings: SearchSettings = DEFAULT_SETTINGS
) -> tuple[Diagnosis, IdentifiedModel]:
    """Return a diagnosis without nonlinear effects that make a simulation by the loads alone worse.

    Where one does, the effect is excluded and the diagnosis repeated; a second time at all places. The time limit is
    that of all together.
    """
    rejected: tuple[str, ...] = ()
    settings = settings.begin()
    while True:
        diagnosis, updated = diagnose(task.model, task.spectra, settings=settings)
        found = {effect_label(effect.name, effect.where) for effect in diagnosis.effects}
        nonlinear = [label for label in nonlinear_effects(updated) if label in found]
        if not nonlinear or not _is_contradicted(task, updated, nonlinear, settings.free_simulation):
            break
        # The second time it is the kind of effect, not the place.
        words = [label.partition("@")[0] for label in (*nonlinear, *rejected)] if rejected else nonlinear
        rejected = (*rejected, *nonlinear)
        settings = replace(settings, excluded=(*settings.excluded, *words))
    trials = tuple(_rejection(label, diagnosis) for label in rejected)
    return replace(diagnosis, trials=(*diagnosis.trials, *trials)), updated


def nonlinear_effects(model: IdentifiedModel) -> tuple[str, ...]:
    """Return NAME@PLACE of the effects that are nonlinear forces or channels.

    Each is taken alone and without its values, which need not be physical without the other effects.
    """
    labels = []
    for item in model.geometry.effects:
        words = {name: value for name, value in item.parameters.items() if isinstance(value, str)}
        alone = model.geometry.model_copy(update={"effects": (item.model_copy(update={"parameters": words}),)})
        if balance_model(alone).system().equations.nonlinear_terms:
            labels.append(effect_label(item.name, item.where))
    return tuple(labels)


def _is_contradicted(
    task: SimulationTask, updated: IdentifiedModel, nonlinear: Iterable[str], settings: FreeSimulationSettings
) -> bool:
    """Whether the updated model simulates the runs worse than the same model fitted without these effects."""
    words = set(nonlinear)
    linear_effects = tuple(
        item for item in updated.geometry.effects if effect_label(item.name, item.where) not in words
    )
    linear_geometry = updated.geometry.model_copy(update={"effects": linear_effects})
    linear = identify(task.spectra, linear_geometry, IdentifyOptions(band=updated.band))
    errors = [
        (simulation_error(run, linear, settings), simulation_error(run, updated, settings))
        for run in _test_runs(task, settings)
    ]
    without, with_effect = (np.array(column, float) for column in zip(*errors, strict=True))
    known = np.isfinite(without)
    worse = np.sqrt(np.mean(with_effect[known] ** 2)) > settings.max_error_ratio * np.sqrt(np.mean(without[known] ** 2))
    return bool(known.any() and worse)


def _test_runs(task: SimulationTask, settings: FreeSimulationSettings) -> list[Run]:
    """Hold-out runs first, then the fitted sweeps of the largest levels, one for each excited component."""
    held = [run for run in task.hold_out if run.has_loads][: settings.max_hold_out]
    sweeps = sorted((run for run in task.fitted if run.kind == "sweep"), key=lambda run: -max((*run.level, 0.0)))
    strongest = list({run.excited: run for run in reversed(sweeps)}.values())
    strongest.sort(key=lambda run: [COMPONENTS.index(name) for name in run.excited])
    return [*held, *strongest[: settings.max_sweeps]]


def _rejection(label: str, diagnosis: Diagnosis) -> Trial:
    number = last_round(diagnosis.trials) + 1
    return refit_trial(number, label, float("nan"), "removed", REASON)
