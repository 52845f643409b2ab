"""Plan a campaign: the runs that tell most of the parameters, the effects and the hub loads in the time of a hall."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import takewhile

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.load_components import carried_components
from balance_cli.estimation.deadline import NO_DEADLINE, Deadline
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.io.errors import UserError
from balance_cli.model.balance import balance_model
from balance_cli.model.plate import moment_reference_length
from balance_cli.planning.candidate_runs import CandidateRun, by_turns, candidate_runs, number_runs
from balance_cli.planning.channel_noise import ChannelNoise, planning_noise
from balance_cli.planning.choices import Aim
from balance_cli.planning.confusion import confused_pairs
from balance_cli.planning.design import Design, Problem, choose_runs, rank_runs
from balance_cli.planning.detectability import DetectionLevel, information_rows
from balance_cli.planning.extended_model import ExtendedModel, extended_model
from balance_cli.planning.forecast import (
    detectable_effects,
    forecast_stages,
    load_sigma,
    parameter_forecasts,
    unpredicted_effects,
)
from balance_cli.planning.further_runs import further_runs
from balance_cli.planning.hall import (
    Hall,
    RecordSettings,
    check_names,
    excitable_components,
    open_hall,
    record_settings,
)
from balance_cli.planning.hub_loads import LoadForecast, load_forecast
from balance_cli.planning.information import (
    RunInformation,
    add_information,
    band_information,
    mean_information,
    planned_information,
    spectra_information,
)
from balance_cli.planning.levels import LevelLimit, band_response, level_limits, limit_spectra
from balance_cli.planning.line_power import PowerProblem, band_edges, bands_of_sweep, optimal_powers
from balance_cli.planning.rehearsal import rehearse
from balance_cli.planning.result import PlannedCampaign
from balance_cli.simulation.excitation import Power
from balance_cli.simulation.plans import AnyPlan, CampaignPlan, Component, SweepPlan
from balance_cli.simulation.rig import TrueRig
from balance_cli.simulation.signal_store import SignalStore
from balance_cli.steps.free_simulation import simulated_rig
from balance_cli.steps.identify import IdentifyOptions, identify

Progress = Callable[[Iterable[CandidateRun], str, int], Iterable[CandidateRun]]


@dataclass(frozen=True)
class PlanOptions:
    """How to plan: `minutes` of hall time, what for, at which level of detection, and what the hall allows.

    After `time_limit` seconds of computing nothing more is rehearsed, exchanged or ranked: lines are then flat where
    their power was not found yet, and the forecast is that of the rehearsals of the choice.
    """

    minutes: float
    aim: Aim = "both"
    detection: DetectionLevel = field(default_factory=DetectionLevel)
    hall: Hall = field(default_factory=open_hall)
    seed: int = 0
    time_limit: float | None = None


@dataclass(frozen=True)
class PlanningRig:
    """All that a plan rests on: the model with its candidates, the rig that rehearses, noise, records and forecast."""

    model: ExtendedModel
    rig: TrueRig
    noise: ChannelNoise
    settings: RecordSettings
    limits: tuple[LevelLimit, ...]
    forecast: LoadForecast | None
    longest: int = 1

    @cached_property
    def signals(self) -> SignalStore:
        """The rig's signals without noise, kept from one rehearsal to the next."""
        return SignalStore(self.rig, self.longest)

    def information(self, plan: AnyPlan, random_seeds: Iterable[int] = (0,)) -> RunInformation:
        """The information that a run is expected to give, in the mean over rehearsals."""
        return planned_information(plan, self.signals, self.noise, self.model, random_seeds)


REHEARSALS = 4
"""Rehearsals of each run of the plan, for the forecast; for the choice among all candidates one is enough.

The number of steady periods and the weights from an estimated covariance are those of the noise: of one rehearsal of
five periods the smallest sizes scatter by 4 %, of four by 2 %."""
NO_SPECTRA = Spectra((), (), {}, {})


def plan_campaign(
    geometry: Geometry,
    options: PlanOptions,
    model: IdentifiedModel | None = None,
    spectra: Spectra = NO_SPECTRA,
    progress: Progress | None = None,
) -> PlannedCampaign:
    """Choose the runs of a campaign, and forecast what they tell.

    `model` and the `spectra` of runs already made (with means and waveforms) are what is known before. Raises UserError
    where the hall, the geometry or the runs leave nothing to plan.
    """
    deadline = Deadline(options.time_limit)
    base = planning_rig(geometry, options.hall, model, spectra)
    # Constraints that cannot hold are met before anything is rehearsed.
    candidate_runs(base.rig.geometry, options.hall, base.settings, base.model.system)
    before = add_information(spectra_information(spectra, base.model), base.model)
    powers = line_powers(base, options, before, deadline, progress)
    candidates = candidate_runs(base.rig.geometry, options.hall, base.settings, base.model.system, powers)
    candidates, information = _rehearse_candidates(base, candidates, options.seed, deadline, progress)
    problem = Problem(
        candidates, information, before, base.model, base.forecast, options.hall.change_minutes, options.aim
    )
    design = choose_runs(problem, options.minutes, deadline)
    if not design.chosen:
        shortest = min(problem.minutes([i]) for i in range(len(candidates)))
        fault = f"no informative run fits into {options.minutes:g} minutes (the shortest takes {shortest:.3g})"
        raise UserError(fault, "--minutes", remedy="Give more time, or shorter periods and set-ups in the hall file")
    return _describe(base, problem, design, options, spectra, deadline, progress)


def line_powers(
    base: PlanningRig,
    options: PlanOptions,
    before: RunInformation,
    deadline: Deadline = NO_DEADLINE,
    progress: Progress | None = None,
) -> Mapping[Component, Power]:
    """The power of the lines of each component, by one rehearsal of a flat sweep.

    None where it is to be flat, or where the deadline comes before all components were rehearsed.
    """
    hall, geometry = options.hall, base.rig.geometry
    if hall.spectrum == "flat" or "multisine" not in hall.excitations:
        return {}
    single = hall.model_copy(
        update={"simultaneous": 1, "rotor_speeds": hall.rotor_speeds[:1], "trims": ({},), "bands": (), "levels": (1.0,)}
        | {"excitations": ("multisine",), "hammer": None, "minutes_per_point": None}
    )
    shortest = base.settings.model_copy(update={"periods": (min(base.settings.periods),)})
    sweeps = candidate_runs(geometry, single, shortest, base.model.system)
    edges = band_edges(base.settings, base.model)
    shown = band_response(geometry, base.settings.band, base.model.system)
    signals, bands = SignalStore(base.rig), []
    for item in progress(sweeps, "bands", len(sweeps)) if progress else sweeps:
        if deadline.is_over:
            return {}
        assert isinstance(item.plan, SweepPlan)
        try:
            spectra = rehearse(item.plan, signals, base.noise, options.seed)
        except UserError as error:
            fault = f"a sweep of {item.plan.excited[0]} with {item.plan.level[0]:.3g} rms gives no usable lines"
            raise UserError(fault, place="exciters", remedy="Give larger levels, or longer periods") from error
        parts = (information_rows(part, base.model) for part in band_information(spectra, base.model, edges))
        limit = next(each for each in base.limits if each.component == item.plan.excited[0])
        share = limit_spectra(limit.component, geometry, shown, limit)
        bands.append(bands_of_sweep(limit.component, edges, shown.frequency, share, parts))
    return optimal_powers(PowerProblem(bands, before, base.model, base.forecast, options.aim))


def _rehearse_candidates(
    base: PlanningRig, candidates: tuple[CandidateRun, ...], seed: int, deadline: Deadline, progress: Progress | None
) -> tuple[tuple[CandidateRun, ...], list[RunInformation]]:
    """The candidates that are rehearsed before the deadline, each kind of set-up in turn, and their information.

    A run that gives no usable lines is no candidate.
    """
    ordered = by_turns(candidates)
    usable: list[CandidateRun] = []
    information: list[RunInformation] = []
    for item in progress(ordered, "runs", len(ordered)) if progress else ordered:
        if usable and deadline.is_over:
            break
        try:
            part = base.information(item.plan, (seed,))
        except UserError:
            continue
        usable.append(item)
        information.append(part)
    if not usable:
        raise UserError("no run of this hall gives usable lines", remedy="Give larger levels, or longer periods")
    return tuple(usable), information


def planning_rig(
    geometry: Geometry, hall: Hall, model: IdentifiedModel | None = None, spectra: Spectra = NO_SPECTRA
) -> PlanningRig:
    """Prepare a plan: without a model the runs are identified, and without runs the geometry is taken as declared."""
    check_names(hall, geometry)
    if model is None:
        options = IdentifyOptions(method="ls+ml" if spectra.lines else "computed")
        model = identify(spectra, geometry, options)
    rig = simulated_rig(model)
    if rig is None:
        names = ", ".join(item.name for item in model.geometry.effects)
        fault = "is in the paper's form" if model.form == "paper" else f"has effects that cannot be simulated ({names})"
        raise UserError(fault, "MODEL", remedy="Give a model of the physical form, without empirical effects")
    extended = extended_model(balance_model(model.geometry).at(model.parameters.value), hall.effects)
    settings = record_settings(model.geometry, hall)
    noise = planning_noise(hall.noise, spectra.lines, settings.sample_rate)
    limits = level_limits(model.geometry, hall, settings, extended.system)
    reference = _reference_loads(model.geometry, hall, limits)
    forecast = load_forecast(extended, noise, reference, settings.sample_rate, hall.record_seconds)
    excitable_components(model.geometry, hall)
    return PlanningRig(extended, rig, noise, settings, limits, forecast, max(settings.periods))


def _reference_loads(geometry: Geometry, hall: Hall, limits: Iterable[LevelLimit]) -> Mapping[str, float]:
    """Amplitude of each hub load for which its sigma counts: as stated, else that of the largest sweep.

    A component that is neither has the largest force of the others, or the moment of that force at the hub's height.
    """
    stated: dict[str, float] = {limit.component: limit.level * 2.0**0.5 for limit in limits}
    for name, value in (hall.loads or {}).items():
        stated[name] = value
    arm = moment_reference_length(geometry.hub)
    force = max(value / (arm if name.startswith("M") else 1.0) for name, value in stated.items())
    other = {name: force * (arm if name.startswith("M") else 1.0) for name in carried_components(geometry)}
    return {**other, **stated}


def _describe(
    base: PlanningRig,
    problem: Problem,
    design: Design,
    options: PlanOptions,
    spectra: Spectra,
    deadline: Deadline,
    progress: Progress | None,
) -> PlannedCampaign:
    selection = design.chosen
    order = sorted(set(selection))
    items: Iterable[CandidateRun] = [problem.candidates[i] for i in order]
    shown = progress(items, "forecast", len(order)) if progress else items
    rehearsed = {
        i: _forecast_information(base, problem, i, options.seed, deadline) for i, _ in zip(order, shown, strict=True)
    }
    stages, total = forecast_stages(problem.before, [rehearsed[i] for i in selection], base.model, options.detection)
    named = number_runs([problem.candidates[i] for i in selection])
    proposals = list({run.run: run for run in problem.information}.values())
    further = _further_information(base, options, deadline)
    return PlannedCampaign(
        rig=base.rig.geometry.rig,
        campaign=CampaignPlan(runs=tuple(item.plan for item in named)),
        chosen=named,
        minutes=design.minutes,
        complete=not deadline.was_reached,
        made=tuple([run.run for run in spectra.lines] + [points.run for points in spectra.statics]),
        noise=base.noise.declared(base.rig.geometry.channels),
        noise_source=base.noise.source,
        detection=options.detection,
        limits=base.limits,
        effects=detectable_effects(stages, base.model, base.forecast, (*proposals, *further)),
        unpredicted=unpredicted_effects(base.model, options.hall.effects),
        confusion=confused_pairs(total, base.model, proposals, further),
        ranking=rank_runs(problem, selection, deadline),
        loads=load_sigma(stages, base.model, base.forecast),
        parameters=parameter_forecasts(stages[0], stages[-1], base.model),
    )


def _further_information(base: PlanningRig, options: PlanOptions, deadline: Deadline) -> tuple[RunInformation, ...]:
    """The information of runs beyond the hall, named by what they are; those that give no usable lines are left out."""
    parts = []
    for item in further_runs(base.rig.geometry, options.hall, base.settings, base.limits, base.model.system):
        if deadline.is_over:
            break
        try:
            parts.append(replace(base.information(item.plan, (options.seed,)), run=item.what, parts=()))
        except UserError:
            continue
    return tuple(parts)


def _forecast_information(
    base: PlanningRig, problem: Problem, index: int, seed: int, deadline: Deadline
) -> RunInformation:
    """The mean of all rehearsals of a candidate before the deadline; the first one is that of the choice."""
    plan = problem.candidates[index].plan
    later = takewhile(lambda _: not deadline.is_over, range(seed + 1, seed + REHEARSALS))
    return mean_information([problem.information[index], *(base.information(plan, (k,)) for k in later)], plan.run)
