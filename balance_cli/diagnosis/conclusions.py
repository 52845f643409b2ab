"""The conclusions of a diagnosis: verdict, evidence for each effect, and notes on what was not tested."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace

from balance_cli.campaign.rig.channel_groups import channel_groups
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.alike_effects import alike_in_all
from balance_cli.diagnosis.model_update import UpdateResult, is_good_fit
from balance_cli.diagnosis.result import (
    CONTRADICTED,
    EXPLAINED,
    NOTHING_MISSING,
    PARTLY_EXPLAINED,
    RECORD_CHANGE_TEST,
    UNEXPLAINED,
    Diagnosis,
    Evidence,
    FoundEffect,
    HoldOut,
    LeftOut,
    Trial,
)
from balance_cli.diagnosis.selection.doubt import doubtful_effects
from balance_cli.diagnosis.selection.fit import Fit
from balance_cli.diagnosis.selection.mains_frequency import frequency_looks, independent_gain
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS, SearchSettings
from balance_cli.diagnosis.significance import bonferroni_p_value
from balance_cli.diagnosis.worth import effect_worth
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.declared_departures import declared_agreement
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.estimation.recorded_loads import swept_components
from balance_cli.io.percent import percent_text
from balance_cli.model.fitted_effects import FittedEffect
from balance_cli.model.placed_effects import PlacedEffect


def decide_verdict(
    effects: Sequence[FoundEffect],
    update: UpdateResult,
    updated: IdentifiedModel,
    settings: SearchSettings,
    left_out: LeftOut | None,
) -> str:
    """Return the verdict, as docs/json.md defines it.

    Without a good fit it is never `nothing missing`; with an empirical effect it is never `explained`. A parameter that
    departs from its declared tolerance is a misfit too: the declaration is a measurement that the model contradicts.
    Effects of no consequence do not change the verdict. Data of which something is left out are explained in part.
    """
    if left_out is not None:
        return PARTLY_EXPLAINED
    good = is_good_fit(update.confirmation, updated.quality, settings) and not declared_agreement(updated).departures
    if not effects:
        return NOTHING_MISSING if good else UNEXPLAINED
    if good and all(effect.is_of_no_consequence for effect in effects):
        return NOTHING_MISSING
    empirical = any(effect.evidence.empirical for effect in effects)
    return EXPLAINED if good and not empirical else PARTLY_EXPLAINED


def judge_drifts(diagnosis: Diagnosis) -> Diagnosis:
    """Return the diagnosis with what drifts within the records, which no effect explains.

    The scatter that it makes is in the measured noise, so that chi-square does not show it. A constant effect of such a
    channel is an average: records of another length have another one.
    """
    level = (diagnosis.settings or DEFAULT_SETTINGS).data_tests.significance_level
    tests = [test for test in diagnosis.data_tests if test.name == RECORD_CHANGE_TEST]
    drifts = [test for test in tests if test.p_value * len(tests) <= level]
    channels = {name for test in drifts for name in test.place.split(", ")}
    groups = channel_groups(diagnosis.geometry)
    averages = [
        effect.label
        for effect in diagnosis.effects
        if channels & {channel for name in effect.where for channel in groups.get(name, (name,))}
    ]
    notes = [f"{test.place}: {test.finding}" for test in drifts]
    if averages:
        states = "is the average" if len(averages) == 1 else "are averages"
        notes.append(f"{', '.join(averages)} {states} of what drifts within the records, not constant")
    verdict = diagnosis.verdict
    if drifts and verdict in (NOTHING_MISSING, EXPLAINED):
        verdict = PARTLY_EXPLAINED
    return replace(diagnosis, notes=(*diagnosis.notes, *notes), verdict=verdict)


def judge_hold_out(diagnosis: Diagnosis, hold_out: Mapping[str, HoldOut], kept_aside: Sequence[str] = ()) -> Diagnosis:
    """Return the diagnosis with the errors of its hold-out runs, which may contradict what was found.

    Where the model does not describe one of them, something is missing, whatever the fitted runs say.
    `kept_aside`: names of those runs that were not given as hold-out runs.
    """
    notes, verdict, settings = diagnosis.notes, diagnosis.verdict, diagnosis.settings or DEFAULT_SETTINGS
    if kept_aside:
        notes = (*notes, f"no hold-out run was given: {', '.join(kept_aside)} kept aside, which no fit has used")
    notes = (*notes, *(f"{name}: {errors.other_set_up}" for name, errors in hold_out.items() if errors.other_set_up))
    improved = [name for name, errors in hold_out.items() if needs_update(errors, settings)]
    if improved and verdict == NOTHING_MISSING and diagnosis.effects:
        verdict = EXPLAINED
        notes = (
            *notes,
            f"the loads of {', '.join(improved)} are right only with the effects found: these matter",
        )
    undescribed = [name for name, errors in hold_out.items() if not is_described(errors, settings)]
    if undescribed and verdict in (NOTHING_MISSING, EXPLAINED):
        # The fitted runs are described: what is missing acts in the hold-out runs alone.
        verdict = PARTLY_EXPLAINED if diagnosis.effects else UNEXPLAINED
        notes = (*notes, *(_describe_misfit(name, hold_out[name]) for name in undescribed))
    worse = [name for name, errors in hold_out.items() if is_worse(errors, settings)]
    if worse and diagnosis.effects:
        notes, verdict = (
            (*notes, f"the update makes {', '.join(worse)} worse: do not use the updated model"),
            CONTRADICTED,
        )
    return replace(diagnosis, hold_out=dict(hold_out), notes=notes, verdict=verdict)


def is_described(errors: HoldOut, settings: SearchSettings) -> bool:
    """Return whether the updated model describes a run, response and loads.

    It does to within the noise of the run, a small error, or the error of parameters that the fitted runs hardly
    inform: what no sweep has excited rests on its declaration.
    """
    limits = settings.hold_out
    after, noise, expected = (
        (0.0, 0.0) if part is None else (part.frf_error, _rms(part.load_error.values()))
        for part in (errors.after, errors.noise, errors.expected)
    )
    return not any(
        error > limits.undescribed_error
        and error > limits.undescribed_noise_ratio * by_noise
        and error > limits.undescribed_expected_ratio * by_parameters
        for error, by_noise, by_parameters in zip(after, noise, expected, strict=True)
    )


def needs_update(errors: HoldOut, settings: SearchSettings) -> bool:
    """Return whether the hub loads of a run are off without the update, by more than noise or a small error."""
    before, after, noise = (_rms(part.load_error.values()) for part in (errors.before, errors.after, errors.noise))
    limits = settings.hold_out
    least = max(limits.undescribed_error, limits.undescribed_noise_ratio * noise, limits.needed_error_ratio * after)
    return before > least


def _describe_misfit(name: str, errors: HoldOut) -> str:
    error, noise = errors.after.frf_error, errors.noise.frf_error
    return (
        f"{name} is not described, although the fitted runs are: its response is off by {percent_text(error, 3)} %, "
        f"by noise alone {percent_text(noise)} %. Find what acts in it and not in the fitted runs: a turning rotor, "
        "another set-up"
    )


def is_worse(errors: HoldOut, settings: SearchSettings) -> bool:
    """Return whether a run has a worse response or worse hub loads after the update than noise alone can make them."""
    parts = (errors.before, errors.after, errors.noise)
    load_errors = [_rms(part.load_error.values()) for part in parts]
    limits = settings.hold_out
    return any(
        after > limits.max_error_ratio * before and after > limits.min_noise_ratio * noise
        for before, after, noise in ([part.frf_error for part in parts], load_errors)
    )


def _rms(values: Iterable[float]) -> float:
    """Rms of the values; NaN where there are none."""
    squares = [value**2 for value in values]
    return float(sum(squares) / len(squares)) ** 0.5 if squares else float("nan")


def describe_added_effects(
    placed: Sequence[PlacedEffect],
    fitted: Sequence[FittedEffect],
    update: UpdateResult,
    intervals: Mapping[str, tuple[float, float]],
    batches: Sequence[Batch],
    settings: SearchSettings,
) -> tuple[FoundEffect, ...]:
    """Return the effects that the update has added, with their evidence, strongest first.

    `fitted`: the effects of the updated model with their parameters; `intervals`: 95 % intervals of parameters whose
    likelihood is far from normal, by full name.
    """
    by_label = {effect.label: effect for effect in fitted}
    doubted = () if update.is_good else doubtful_effects(update.fit, update.effect_support, batches, settings.selection)
    swept, effects = swept_components(batches), []
    for effect in placed:
        support = update.effect_support.get(effect.label)
        if support is None:
            continue
        described = by_label[effect.label]
        others, remedy = _alternatives(effect, support.equivalent, update.fit.geometry, swept)
        parameters = tuple(
            replace(item, interval=intervals.get(f"{effect.label}.{item.name}")) for item in described.parameters
        )
        effects.append(
            FoundEffect(
                name=described.name,
                where=described.where,
                parameters=parameters,
                evidence=_evidence(effect, update, batches, settings),
                indistinguishable_from=others,
                separated_by=remedy,
                choice=described.choice,
                worth=effect_worth(update.fit, effect, batches, settings),
                is_doubtful=effect.label in doubted or None,
            )
        )
    return tuple(sorted(effects, key=lambda item: -item.evidence.gain))


def _alternatives(
    effect: PlacedEffect, equivalent: tuple[str, ...], geometry: Geometry, swept: Collection[str]
) -> tuple[tuple[str, ...], str]:
    """The effects that describe the data as well, those found to be `equivalent` first, and what separates them."""
    alike = alike_in_all(effect, geometry, swept=swept)
    if alike is not None:
        return (*equivalent, alike.label), alike.separated_by
    return equivalent, effect.effect.separated_by if equivalent else ""


def _evidence(
    effect: PlacedEffect, update: UpdateResult, batches: Sequence[Batch], settings: SearchSettings
) -> Evidence:
    support = update.effect_support[effect.label]
    count = len(update.confirmation.scores) if support.candidates is None else support.candidates
    tests = count * frequency_looks(update.fit, effect, batches, settings)
    independent = independent_gain(support.gain, update.fit, effect, batches)
    trial = next((item for item in update.trials if _added(item, effect.label)), None)
    noise_dof = float("inf") if trial is None or trial.noise_dof is None else trial.noise_dof
    return Evidence(
        gain=support.gain,
        parameters=support.parameters,
        p_value=bonferroni_p_value(independent, max(support.parameters, 1), tests, noise_dof),
        score=trial.score if trial else float("nan"),
        cross_validation_gain=trial.cross_validation_gain if trial else float("nan"),
        round=trial.round if trial else 0,
        empirical=effect.effect.empirical,
    )


def _added(trial: Trial, label: str) -> bool:
    """Whether a trial added the effect, perhaps at a larger place than now."""
    name, _, where = label.partition("@")
    trial_name, _, trial_where = trial.label.partition("@")
    same = name == trial_name and set(where.split(",")) <= set(trial_where.split(","))
    return trial.decision == "accepted" and same


def diagnosis_notes(spectra: Spectra, fit: Fit, updated: IdentifiedModel, settings: SearchSettings) -> tuple[str, ...]:
    """Return notes on what the runs leave untested, and on a chi-square that is too small."""
    notes = [departure.description for departure in declared_agreement(updated).departures]
    notes += describe_offsets(fit)
    bin_sums = any(run.waveform is not None and run.waveform.lines_are_bin_sums for run in spectra.lines)
    too_good = updated.quality.chi2_per_dof < settings.selection.too_good_chi2_per_dof
    if fit.system().equations.nonlinear_terms and bin_sums and too_good:
        notes.append(
            "chi2/dof is below one because the noise of records that do not repeat was measured with the nonlinear "
            "terms still in it: every sigma and p-value is on the safe side"
        )
    levels: dict[tuple[tuple[str, ...], float], set[tuple[float, ...]]] = {}
    for run in spectra.lines:
        levels.setdefault((run.components, run.rotor_speed), set()).add(tuple(run.level))
    if all(len(each) == 1 for each in levels.values()):
        notes.append("every component was excited at one level only: levels were not compared")
    if len({run.rotor_speed for run in spectra.lines}) == 1:
        notes.append("all sweeps have one rotor speed: speeds were not compared")
    if not spectra.statics:
        notes.append("no static run: the static response was not tested")
    return tuple(notes)


def describe_offsets(fit: Fit) -> list[str]:
    """Say that offsets of channels change no load: the zeros of bridges are everyday, and look like an effect."""
    offsets = [effect for effect in fit.model.effects if effect.effect.is_zero_reading]
    if not offsets or fit.system().equations.has_nonlinear_terms:
        return []
    text = "no harmonic load depends on such zeros, and a zero run takes them out of the mean loads"
    places = ", ".join(place for effect in offsets for place in effect.where)
    return [f"{offsets[0].effect.name} of {places}: {text}"]
