"""Close the loop: find what a model lacks, add it, and say what it was worth."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.data_tests.model_free import model_free_tests
from balance_cli.diagnosis.residual_map import location, residual_map
from balance_cli.diagnosis.result import (
    EXPLAINED,
    NOTHING_MISSING,
    PARTLY_EXPLAINED,
    UNEXPLAINED,
    Diagnosis,
    Evidence,
    FoundEffect,
    Trial,
)
from balance_cli.diagnosis.search.initial_candidates import initial_candidates
from balance_cli.diagnosis.search.mass_region import mass_intervals
from balance_cli.diagnosis.search.refit import SearchState
from balance_cli.diagnosis.search.search import LARGE_MODEL_ERROR, SearchResult, search
from balance_cli.diagnosis.search.search_lines import search_lines
from balance_cli.diagnosis.search.unmodelled_modes import add_unmodelled_modes
from balance_cli.diagnosis.selection.alternatives import EffectSupport, compare_alternatives
from balance_cli.diagnosis.selection.confirm import SIGNIFICANCE_LEVEL, ConfirmedFit, bonferroni_p_value, confirm
from balance_cli.diagnosis.selection.effect_selection import drop_unsupported_effects, keep_effects, prune_effects
from balance_cli.diagnosis.selection.fit import Fit, fit_all_lines
from balance_cli.diagnosis.selection.mains_frequency import refit_at_best_frequency
from balance_cli.diagnosis.selection.testability import not_testable
from balance_cli.estimation.fit_quality import fit_quality
from balance_cli.estimation.identifiability import parameter_identifiability
from balance_cli.estimation.identified_model import FitQuality, IdentifiedModel
from balance_cli.estimation.likelihood import data_curvature
from balance_cli.estimation.maximum_likelihood import TOLERANCE
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.estimation.measurements import Batch, stack_runs
from balance_cli.estimation.model_error import add_model_error
from balance_cli.io.errors import UserError
from balance_cli.model.balance import BalanceModel, balance_model
from balance_cli.model.fitted_effects import FittedEffect
from balance_cli.model.placed_effects import declared_effects
from balance_cli.signals.run_spectrum import RecordWaveform
from balance_cli.steps.identify import build_identified_model, identified_effects

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

GOOD_FIT = 1.2
"""Chi-square per degree of freedom up to which a model describes its data (contract, verdicts)."""
TOO_GOOD = 0.7
"""Chi-square per degree of freedom below which the noise was less than was measured."""
MAX_PASSES = 2
"""How often what is missing is asked, once more where a rival has taken an effect's place."""


def diagnose(
    model: IdentifiedModel, spectra: Spectra, progress: Progress | None = None
) -> tuple[Diagnosis, IdentifiedModel]:
    """The diagnosis, without hold-out runs, and the closed model.

    `spectra` come with means and waveforms. Raises UserError for a model of the paper's form, and without any sweep.
    """
    if model.form != "physical":
        raise UserError("the paper's form has no parameters to add to", "MODEL", remedy="Identify with --form physical")
    if not spectra.lines:
        raise UserError("no sweep run to diagnose with", remedy="Give at least one sweep run")
    announce = _Steps(progress)
    batches = stack_runs(spectra.lines, spectra.statics, model.geometry.channel_names)
    start = balance_model(model.geometry)
    before = (start, np.array(model.parameters.value, float))
    update = _update_model(*before, spectra, batches, announce)
    fit, after, quality = update.fit, (update.fit.model, update.fit.theta), _quality(*before, batches)
    updated_model = build_identified_model(
        fit.model, batches, fit.minimum, "ml", "diagnosis", spectra.channels_left_out
    )
    if _effect_labels(fit.model) == _effect_labels(start) and updated_model.quality.chi2 > quality.chi2:
        # Nothing came in or went, and a fit that had to carry a model error is no better than the one given.
        updated_model, after = model, before
    effects = _added_effects_with_evidence(updated_model, update, mass_intervals(fit.model, fit.theta, batches))
    residuals = residual_map(batches, before, after)
    verdict = _verdict(effects, update.confirmation, updated_model.quality)
    diagnosis = Diagnosis(
        geometry=model.geometry,
        verdict=verdict,
        effects=effects,
        trials=update.trials,
        tests=model_free_tests(spectra, model.geometry, float(updated_model.modes.frequency.min())),
        not_testable=not_testable(update.confirmation.scores, spectra, fit.model.geometry),
        chi2_per_dof_before=quality.chi2_per_dof,
        chi2_per_dof_after=updated_model.quality.chi2_per_dof,
        frf_error_before=quality.frf_error,
        frf_error_after=updated_model.quality.frf_error,
        modes_before=model.modes,
        modes_after=updated_model.modes,
        residual=residuals,
        candidates=len(update.confirmation.scores),
        location="" if verdict in (NOTHING_MISSING, EXPLAINED) else location(residuals),
        notes=_notes(spectra, fit, updated_model.quality),
    )
    announce("done")
    return diagnosis, updated_model


@dataclass(frozen=True)
class _UpdateResult:
    """Where the loop ended: the fit, how each effect in it stands, all that was tried, and the tests against noise."""

    fit: Fit
    effect_support: dict[str, EffectSupport]
    trials: tuple[Trial, ...]
    confirmation: ConfirmedFit


def _update_model(
    start: BalanceModel, theta: Array, spectra: Spectra, batches: Sequence[Batch], announce: Callable[[str], None]
) -> _UpdateResult:
    """Search, and test what was found; where that leaves a residual, with resonances that describe it."""
    lines = search_lines(spectra, start.geometry.channel_names)
    given_labels = _effect_labels(start)
    announce("search")
    found = search(start, theta, lines, announce, initial_candidates(spectra.lines, start.geometry))
    certain_labels = given_labels | {item.label for item in found.trials if item.round == 0}
    update = _test_on_all_lines(found.state, batches, given_labels, certain_labels, found, announce)
    if _is_good_fit(update.confirmation, _quality(update.fit.model, update.fit.theta, batches)):
        return update
    # A resonance that nobody has written down may have passed for an effect: it is also sought without those found.
    starting_models = [(update.fit.model, update.fit.theta)]
    if not _effect_labels(update.fit.model) <= certain_labels:
        starting_models.append(keep_effects(certain_labels, update.fit.model.geometry, start, theta))
    state, tried = add_unmodelled_modes(starting_models, lines, _last_round(update.trials) + 1, announce)
    trials = (*update.trials, *tried)
    if state is None:
        return replace(update, trials=trials)
    return _test_on_all_lines(state, batches, given_labels, certain_labels, replace(found, trials=trials), announce)


def _test_on_all_lines(
    state: SearchState,
    batches: Sequence[Batch],
    given_labels: Collection[str],
    certain_labels: Collection[str],
    found: SearchResult,
    announce: Callable[[str], None],
) -> _UpdateResult:
    """What holds of a search on all lines: confirmed, pruned, believed, and held against its rivals."""
    announce("maximum likelihood of all lines")
    # While the model is still wrong, nothing can be judged by the noise alone.
    wrong = state.error > LARGE_MODEL_ERROR
    judged = add_model_error(batches, state.shares) if wrong else batches
    fit = fit_all_lines(state.model, state.theta, judged)
    fit = refit_at_best_frequency(fit, declared_effects(fit.model.geometry), judged)
    trials, alternatives = found.trials, _search_alternatives(found)
    for look in range(MAX_PASSES):
        confirmation = confirm(fit, judged, not wrong, _last_round(trials) + 1, announce)
        announce("what is needed")
        trials, alternatives = (*trials, *confirmation.trials), {**alternatives, **_confirm_alternatives(confirmation)}
        count, last = len(confirmation.scores), _last_round(trials) + 1
        fit, removed = prune_effects(confirmation.fit, judged, count, last)
        fit, doubted = drop_unsupported_effects(fit, judged, not wrong, certain_labels, last)
        stands = compare_alternatives(fit, judged, given_labels, alternatives, count, last + 1, announce)
        trials, fit = (*trials, *removed, *doubted, *stands.trials), stands.fit
        if not stands.trials or look == MAX_PASSES - 1:
            break
    fit = fit_all_lines(fit.model, fit.theta, judged, TOLERANCE)
    return _UpdateResult(fit, stands.effect_support, trials, confirmation)


def _effect_labels(model: BalanceModel) -> set[str]:
    return {one.label for one in declared_effects(model.geometry)}


def _last_round(trials: Sequence[Trial]) -> int:
    return max((trial.round for trial in trials), default=0)


class _Steps:
    """Tells the progress; every call is a step further, the last one the end."""

    EXPECTED = 16

    def __init__(self, progress: Progress | None) -> None:
        self._progress, self._count = progress, 0

    def __call__(self, what: str) -> None:
        self._count += 1
        if self._progress is not None:
            self._progress(what, 1.0 if what == "done" else min(self._count / self.EXPECTED, 0.95))


def _quality(model: BalanceModel, theta: Array, batches: Sequence[Batch]) -> FitQuality:
    """How well the model given describes the lines, as it is."""
    system = model.system(theta)
    effective_parameters = parameter_identifiability(
        model.parameters, data_curvature(batches, system).information
    ).effective_parameters
    return fit_quality(batches, system, effective_parameters)


def _is_good_fit(confirmation: ConfirmedFit, quality: FitQuality) -> bool:
    return confirmation.smallest_p_value >= SIGNIFICANCE_LEVEL and quality.chi2_per_dof <= GOOD_FIT


def _verdict(effects: Sequence[FoundEffect], confirmation: ConfirmedFit, quality: FitQuality) -> str:
    """As in the contract; a fit that is no good is never `nothing missing`, nor `explained` what is only described."""
    good = _is_good_fit(confirmation, quality)
    if not effects:
        return NOTHING_MISSING if good else UNEXPLAINED
    empirical = any(effect.evidence.empirical for effect in effects)
    return EXPLAINED if good and not empirical else PARTLY_EXPLAINED


def _added_effects_with_evidence(
    updated_model: IdentifiedModel, update: _UpdateResult, intervals: Mapping[str, tuple[float, float]]
) -> tuple[FoundEffect, ...]:
    """The effects that the loop has added, strongest first; those of the model given are not news.

    `intervals`: those of 95 % of parameters, by their full names, where sigma says little.
    """
    described_effects = {one.label: one for one in identified_effects(updated_model)}
    result = []
    for one in declared_effects(updated_model.geometry):
        if one.label not in update.effect_support:
            continue
        stands = update.effect_support[one.label]
        came = next(
            (item for item in update.trials if item.decision == "accepted" and _is_same_effect(item.label, one.label)),
            None,
        )
        evidence = Evidence(
            gain=stands.gain,
            parameters=stands.parameters,
            p_value=bonferroni_p_value(stands.gain, max(stands.parameters, 1), len(update.confirmation.scores)),
            score=came.score if came else float("nan"),
            folds=came.folds if came else float("nan"),
            round=came.round if came else 0,
            empirical=one.effect.empirical,
        )
        bounded = tuple(
            replace(item, interval=intervals.get(f"{one.label}.{item.name}"))
            for item in described_effects[one.label].parameters
        )
        effect = replace(described_effects[one.label], parameters=bounded)
        result.append(_found_effect(effect, evidence, stands.alike, one.effect.separated_by))
    return tuple(sorted(result, key=lambda item: -item.evidence.gain))


def _is_same_effect(tried: str, label: str) -> bool:
    """Whether an effect that was tried is this one, perhaps at a smaller place by now."""
    name, _, where = label.partition("@")
    other, _, there = tried.partition("@")
    return name == other and set(where.split(",")) <= set(there.split(","))


def _search_alternatives(found: SearchResult) -> dict[str, tuple[str, ...]]:
    """Rivals that came near an effect in its round of the search."""
    near = {}
    for label, gains in found.alternatives.items():
        near[label] = tuple(name for name, gain in gains.items() if name != label and gain > 0.9 * gains[label])
    return near


def _confirm_alternatives(confirmation: ConfirmedFit) -> dict[str, tuple[str, ...]]:
    """Rivals that came near an effect in its round of the tests against the noise."""
    return {label: _labels_within_gap(gaps) for label, gaps in confirmation.alternatives.items()}


def _labels_within_gap(gaps: dict[str, float]) -> tuple[str, ...]:
    return tuple(name for name, gap in sorted(gaps.items(), key=lambda item: item[1]) if gap < ALTERNATIVE_GAP)


ALTERNATIVE_GAP = 30.0
"""Chi-square by which a rival may have been behind in its round and still be looked at in the end."""


def _found_effect(effect: FittedEffect, evidence: Evidence, same: tuple[str, ...], separated_by: str) -> FoundEffect:
    separated_by = separated_by if same else ""
    return FoundEffect(effect.name, effect.where, effect.parameters, evidence, same, separated_by, effect.choice)


def _notes(spectra: Spectra, fit: Fit, quality: FitQuality) -> tuple[str, ...]:
    """What the runs given leave untested, and what to make of a chi-square that is too small."""
    notes = []
    distorted = any(isinstance(run.waveform, RecordWaveform) for run in spectra.lines)
    if fit.model.system(fit.theta).forces and distorted and quality.chi2_per_dof < TOO_GOOD:
        notes.append(
            "chi2/dof is below one because the noise of records that do not repeat was measured with the forces found "
            "still in it: every sigma and p is on the safe side"
        )
    levels = {(run.components, run.rotor_speed): set() for run in spectra.lines}  # type: ignore[var-annotated]
    for run in spectra.lines:
        levels[(run.components, run.rotor_speed)].add(tuple(run.level))
    if all(len(each) == 1 for each in levels.values()):
        notes.append("every component was excited at one level only: nothing was compared across levels")
    if len({run.rotor_speed for run in spectra.lines}) == 1:
        notes.append("all sweeps have one rotor speed: nothing was compared across speeds")
    if not spectra.statics:
        notes.append("no static run: what the balance does at rest was not tested")
    return tuple(notes)
