"""Model updating: search for effects, test them on all lines, and describe what remains by unmodelled modes."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.diagnosis.result import Trial
from balance_cli.diagnosis.search.candidates import is_excluded
from balance_cli.diagnosis.search.extended_models import extend_model
from balance_cli.diagnosis.search.initial_candidates import initial_candidates
from balance_cli.diagnosis.search.late_channels import late_channels
from balance_cli.diagnosis.search.refit import SearchState
from balance_cli.diagnosis.search.search import SearchResult, search
from balance_cli.diagnosis.search.search_lines import SearchLines, search_lines
from balance_cli.diagnosis.search.set_ups import set_up_candidates
from balance_cli.diagnosis.search.spin_candidates import spin_candidates
from balance_cli.diagnosis.search.trials import last_round
from balance_cli.diagnosis.search.unmodelled_modes import add_unmodelled_modes
from balance_cli.diagnosis.selection.alternatives import EffectSupport, compare_alternatives
from balance_cli.diagnosis.selection.common_causes import merge_common_causes
from balance_cli.diagnosis.selection.confirm import ConfirmedFit, confirm, score_again
from balance_cli.diagnosis.selection.effect_selection import keep_effects, narrow_places, select_effects
from balance_cli.diagnosis.selection.fit import Fit, approach_on_some_lines, continue_fit, fit_all_lines
from balance_cli.diagnosis.selection.hypotheses import examine_hypotheses
from balance_cli.diagnosis.selection.mains_frequency import refit_at_best_frequency
from balance_cli.diagnosis.selection.selection_task import SelectionTask
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.choices import GOOD_FIT_CHI2_PER_DOF
from balance_cli.estimation.fit_quality import fit_quality, frf_band
from balance_cli.estimation.force_noise import add_force_noise
from balance_cli.estimation.identifiability import parameter_identifiability
from balance_cli.estimation.identified_model import FitQuality
from balance_cli.estimation.levenberg_marquardt import predicted_decrease
from balance_cli.estimation.likelihood import data_curvature
from balance_cli.estimation.maximum_likelihood import TOLERANCE
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.estimation.model_error import add_model_error, estimate_model_error
from balance_cli.model.balance import Estimate
from balance_cli.model.effects import EFFECTS
from balance_cli.model.placed_effects import declared_effects

Array = NDArray[np.float64]
Announce = Callable[[str], bool]


@dataclass(frozen=True)
class UpdateResult:
    """The fit of the updated model, the support of each effect in it, all trials, and the last confirmation.

    `is_good`: whether it describes all lines, and no candidate is significant.
    """

    fit: Fit
    effect_support: dict[str, EffectSupport]
    trials: tuple[Trial, ...]
    confirmation: ConfirmedFit
    is_good: bool


@dataclass(frozen=True)
class _UpdateTask:
    """What an update is made of: the estimate to start from, the lines, and which effects are certain.

    `given_labels`: effects of the starting model; `certain_labels`: these and the ones that the channels demand.
    """

    start: Estimate
    batches: Sequence[Batch]
    lines: SearchLines
    given_labels: Collection[str]
    certain_labels: Collection[str]
    announce: Announce
    settings: SearchSettings


def update_model(
    start: Estimate,
    spectra: Spectra,
    batches: Sequence[Batch],
    given_labels: Collection[str],
    announce: Announce,
    settings: SearchSettings,
) -> UpdateResult:
    """Return the model of `start`, updated to describe the spectra.

    Effects of the start that are not among `given_labels` are shown by the data alone.
    """
    lines = search_lines(spectra, start.geometry.channel_names, settings.fit)
    announce("search")
    initial_sets = (
        *initial_candidates(spectra.lines, start.geometry, settings),
        *spin_candidates(spectra.lines, start.geometry, settings),
    )
    find_late = partial(late_channels, spectra.lines, start.geometry, settings)
    of_set_ups = set_up_candidates(spectra.lines, start.geometry, settings)
    search_result = search(start, lines, announce, initial_sets, find_late, of_set_ups, settings)
    certain_labels = effect_labels(start) | {trial.label for trial in search_result.trials if trial.round == 0}
    task = _UpdateTask(start, batches, lines, given_labels, certain_labels, announce, settings)
    update = _test_on_all_lines(task, search_result)
    if update.is_good:
        return update
    if announce("resonances without a cause"):
        return update
    first_round = last_round(update.trials) + 1
    state, tried = add_unmodelled_modes(_starts_of_modes(task, update), lines, first_round, announce, settings)
    trials = (*update.trials, *tried)
    if state is not None:
        # The lines of the search do not show a motion that grows without bound, as no record does.
        with suppress(np.linalg.LinAlgError):
            return _test_on_all_lines(task, replace(search_result, state=state, trials=trials))
    return replace(update, trials=trials)


def add_zeros(estimate: Estimate, offsets: Mapping[str, float], settings: SearchSettings) -> Estimate:
    """Return an estimate with the zeros [V] of channels, by name, that it does not have and that are not excluded."""
    (name,) = (effect.name for effect in EFFECTS if effect.is_zero_reading)
    geometry = estimate.geometry
    known = {item.where for item in geometry.effects if item.name == name}
    added = tuple(
        DeclaredEffect(name=name, where=(channel,), parameters={"offset": value})
        for channel, value in offsets.items()
        if (channel,) not in known and not is_excluded(name, (channel,), settings.excluded)
    )
    if not added:
        return estimate
    return extend_model(estimate, geometry.model_copy(update={"effects": (*geometry.effects, *added)}))


def _starts_of_modes(task: _UpdateTask, update: UpdateResult) -> list[Estimate]:
    """The models to which modes are added: the updated one, and one without the effects that a mode may have caused."""
    if effect_labels(update.fit) <= set(task.certain_labels):
        return [update.fit]
    return [update.fit, keep_effects(task.certain_labels, update.fit.geometry, task.start)]


@dataclass(frozen=True)
class _Stage:
    """The fit on all lines after a stage of the selection, and by label of each effect those that came near it."""

    fit: Fit
    trials: tuple[Trial, ...]
    alternatives: Mapping[str, tuple[str, ...]]

    @property
    def next_round(self) -> int:
        """The number of the next round."""
        return last_round(self.trials) + 1

    def add(self, fit: Fit, trials: Sequence[Trial]) -> _Stage:
        """Return the stage after further trials, which have led to this fit."""
        return replace(self, fit=fit, trials=(*self.trials, *trials))


def _test_on_all_lines(task: _UpdateTask, search_result: SearchResult) -> UpdateResult:
    """Test the result of a search on all lines: confirm, prune, drop what is unsupported, and compare alternatives."""
    task.announce("maximum likelihood of all lines")
    # Other effects would describe the noise of nonlinear forces where the weights lack it.
    task = replace(task, batches=add_force_noise(task.batches, search_result.state.system(derivatives=False)))
    settings, last_pass = task.settings, task.settings.selection.max_passes - 1
    stage, selection = _first_stage(task, search_result)
    for number in range(last_pass + 1):
        stage, confirmation = _confirm(stage, selection)
        changed = bool(selection.error_runs) and _has_new_effects(stage.fit, task)
        refit = _refit_against_noise(stage.fit, task) if changed else None
        if refit is not None:
            selection = replace(selection, batches=task.batches, error_runs=())
            stage, confirmation = _confirm(replace(stage, fit=refit), selection)
        over = task.announce("effect selection")
        stage = stage.add(*merge_common_causes(stage.fit, selection, stage.next_round))
        count, last = len(confirmation.scores), stage.next_round
        stage = stage.add(*select_effects(stage.fit, selection, count, last))
        comparison = compare_alternatives(stage.fit, selection, stage.alternatives, count, last + 1)
        stage = stage.add(comparison.fit, comparison.trials)
        if over or not comparison.trials or number == last_pass:
            break
    tested = examine_hypotheses(stage.fit, selection.batches, stage.next_round, settings)
    fit = continue_fit(tested.fit, selection.batches, replace(settings.fit, comparison_tolerance=TOLERANCE))
    support = {**comparison.effect_support, **tested.support}
    confirmation = score_again(confirmation, fit, selection.batches, settings)
    known = None if selection.error_runs else fit.minimum.data.information
    is_good = is_good_fit(confirmation, model_quality(fit, task.batches, known), settings)
    return UpdateResult(fit, support, (*stage.trials, *tested.trials), confirmation, is_good)


def _confirm(stage: _Stage, selection: SelectionTask) -> tuple[_Stage, ConfirmedFit]:
    """The stage with the significant effects that it lacks, and how they were confirmed."""
    confirmation = confirm(stage.fit, selection, stage.next_round)
    near = _confirm_alternatives(confirmation, selection.settings)
    stage = stage.add(confirmation.fit, confirmation.trials)
    return replace(stage, alternatives={**stage.alternatives, **near}), confirmation


def _first_stage(task: _UpdateTask, search_result: SearchResult) -> tuple[_Stage, SelectionTask]:
    """The state of the search fitted on all lines, and what its effects are tested with."""
    state, settings, trials = search_result.state, task.settings, search_result.trials
    # While the model still has an error, the noise alone is no measure of significance.
    noise_alone = state.error <= settings.rounds.large_error
    batches = task.batches if noise_alone else add_model_error(task.batches, state.shares)
    fit, narrowed = _fit_and_narrow(state, batches, noise_alone, last_round(trials) + 1, settings)
    # The lines of the search hold the start transient, which looks like an error of the model.
    refit = None if noise_alone or _has_new_effects(fit, task) else _refit_against_noise(fit, task)
    if refit is not None:
        fit, batches, noise_alone = refit, task.batches, True
    error_runs = frozenset(name for name, share in state.shares.items() if share > 0 and not noise_alone)
    stage = _Stage(fit, (*trials, *narrowed), _search_alternatives(search_result, settings))
    known = (task.given_labels, task.certain_labels)
    return stage, SelectionTask(batches, settings, task.announce, error_runs, *known)


def _fit_and_narrow(
    state: SearchState, batches: Sequence[Batch], noise_alone: bool, number: int, settings: SearchSettings
) -> tuple[Fit, tuple[Trial, ...]]:
    """The fit on all lines; where it follows a valley, first without the motions of effects that nothing determines.

    Where the weights carry a model error (not `noise_alone`), they may hide what a motion explains.
    """
    trials: tuple[Trial, ...] = ()
    start = approach_on_some_lines(state, batches, settings.fit)
    fit = fit_all_lines(start, batches, settings.fit, settings.fit.steps_before_valley)
    if noise_alone and not fit.minimum.converged:
        fit, trials = narrow_places(fit, batches, number, settings)
    if not fit.minimum.converged:
        fit = continue_fit(fit, batches, settings.fit)
    return refit_at_best_frequency(fit, declared_effects(fit.geometry), batches, settings), trials


def _has_new_effects(fit: Fit, task: _UpdateTask) -> bool:
    """Whether the effects of a fit are others than those of the model that was given."""
    return effect_labels(fit) != effect_labels(task.start)


def _refit_against_noise(fit: Fit, task: _UpdateTask) -> Fit | None:
    """The fit against the noise alone; None where all lines show an error of the model."""
    settings = task.settings
    fit = fit_all_lines(fit, task.batches, settings.fit, settings.fit.contender_steps)
    if not fit.minimum.converged:
        remaining = 1.0 - predicted_decrease(fit.minimum.total) / fit.chi2
        # The error is about in proportion to the root of chi-square.
        if _model_error(fit, task) * np.sqrt(max(remaining, 0.0)) > settings.rounds.large_error:
            return None
        fit = continue_fit(fit, task.batches, settings.fit)
    fit = refit_at_best_frequency(fit, declared_effects(fit.geometry), task.batches, settings)
    return fit if _model_error(fit, task) <= settings.rounds.large_error else None


def _model_error(fit: Fit, task: _UpdateTask) -> float:
    """Rms over the runs of the model error that all lines show, a share of the response."""
    system = fit.system(derivatives=False)
    shares = estimate_model_error(task.batches, system, None, task.settings.residual_map.sigma)
    return float(np.sqrt(np.mean(np.square(list(shares.values())))))


def _search_alternatives(search_result: SearchResult, settings: SearchSettings) -> dict[str, tuple[str, ...]]:
    """By label of each effect, the candidates that gained about as much in its round of the search."""
    share = settings.rounds.alternative_gain_share
    return {
        label: tuple(name for name, gain in gains.items() if name != label and gain > share * gains[label])
        for label, gains in search_result.alternatives.items()
    }


def _confirm_alternatives(confirmation: ConfirmedFit, settings: SearchSettings) -> dict[str, tuple[str, ...]]:
    """By label of each effect, the candidates that came near it in its round of the confirmation, nearest first."""
    return {
        label: tuple(
            name for name in sorted(gaps, key=lambda name: gaps[name]) if gaps[name] < settings.alternative_gap
        )
        for label, gaps in confirmation.alternatives.items()
    }


def effect_labels(estimate: Estimate) -> set[str]:
    """Return the labels of the effects of a model."""
    return {effect.label for effect in declared_effects(estimate.geometry)}


def model_quality(estimate: Estimate, batches: Sequence[Batch], information: Array | None = None) -> FitQuality:
    """Return how well an estimate describes the lines.

    `information`: that of the lines (f, f), where it is known.
    """
    system = estimate.system()
    if information is None:
        information = data_curvature(batches, system).information
    identifiability = parameter_identifiability(estimate.model.parameters, information)
    return fit_quality(batches, system, identifiability.effective_parameters, frf_band(batches, estimate.geometry))


def is_good_fit(confirmation: ConfirmedFit, quality: FitQuality, settings: SearchSettings) -> bool:
    """Return whether no candidate is significant and chi2/dof is that of a good fit."""
    insignificant = confirmation.smallest_p_value >= settings.selection.significance_level
    return insignificant and quality.chi2_per_dof <= GOOD_FIT_CHI2_PER_DOF
