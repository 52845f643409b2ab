"""Alternatives of each effect: effects that describe the data as well in its place, and those that do it better."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

from balance_cli.diagnosis.result import Trial
from balance_cli.diagnosis.search.candidates import Candidate, candidates, parameters_of_interest
from balance_cli.diagnosis.search.extended_models import add_candidates, extend_model
from balance_cli.diagnosis.search.point_mass import place_mass_candidates, refine_point_mass
from balance_cli.diagnosis.search.score_statistics import Score, score_in_two_stages
from balance_cli.diagnosis.search.trials import refit_trial
from balance_cli.diagnosis.selection.candidate_refits import start_scored_candidate
from balance_cli.diagnosis.selection.effect_selection import prune_effects, refit_without_effect, without_effect
from balance_cli.diagnosis.selection.effect_statistics import effect_wald_statistic
from balance_cli.diagnosis.selection.fit import Fit, fit_contenders
from balance_cli.diagnosis.selection.selection_task import SelectionTask
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.estimation.batch import Batch
from balance_cli.model.balance import Estimate
from balance_cli.model.placed_effects import PlacedEffect, declared_effects


@dataclass(frozen=True)
class EffectSupport:
    """What an effect of the updated model gains in chi-square, with so many identifiable parameters.

    `equivalent`: labels of effects that describe the data as well in its place. `candidates`: among how many it was the
    best (None: all).
    """

    gain: float
    parameters: int
    equivalent: tuple[str, ...]
    candidates: int | None = None


@dataclass(frozen=True)
class ComparisonResult:
    """The fit with the better of each effect and its alternatives, the support of each effect, and the replacements."""

    fit: Fit
    effect_support: dict[str, EffectSupport] = field(default_factory=dict)
    trials: tuple[Trial, ...] = ()


@dataclass(frozen=True)
class _Comparison:
    """An effect of a fit against its alternatives.

    `support`: of the effect; `refits`: fits with alternatives in its place, by label; `better`: the label of one that
    should replace it.
    """

    support: EffectSupport
    refits: dict[str, Fit]
    better: str | None


def compare_alternatives(
    fit: Fit, task: SelectionTask, alternatives: Mapping[str, Sequence[str]], count: int, number: int
) -> ComparisonResult:
    """Compare every effect that is not given with its `alternatives` (labels), and a weak one with all candidates.

    An alternative replaces an effect where it gains more than chance and its parameters can. Effects that it makes
    unnecessary are removed, and all effects are compared once more: two small effects may have stood for a large one.
    """
    known, result = dict(alternatives), ComparisonResult(fit)
    while effect := _next_effect(result, task.given_labels):
        over = task.announce(f"evidence of {effect.label}")
        label, fit = effect.label, result.fit
        comparison = (
            _Comparison(EffectSupport(*effect_wald_statistic(fit, effect), ()), {}, None)
            if over
            else _compare(fit, effect, task.batches, known.get(label, ()), task.settings)
        )
        better = comparison.better
        if better is None or len(result.trials) >= 2 * task.settings.selection.max_replaced:
            support = {**result.effect_support, label: comparison.support}
            result = ComparisonResult(fit, support, result.trials)
            continue
        refit = comparison.refits[better]
        replaced = _replacement_trials(number, label, better, fit.chi2 - refit.chi2, comparison.support.parameters)
        known[better] = (label, *known.get(label, ()))
        fit, removed = prune_effects(refit, task, count, number)
        result = ComparisonResult(fit, {}, (*result.trials, *replaced, *removed))
    return result


def _next_effect(result: ComparisonResult, given_labels: Collection[str]) -> PlacedEffect | None:
    """The first effect that is not given and has not been compared."""
    effects = declared_effects(result.fit.geometry)
    compared = {*given_labels, *result.effect_support}
    return next((effect for effect in effects if effect.label not in compared), None)


def _compare(
    fit: Fit, effect: PlacedEffect, batches: Sequence[Batch], names: Sequence[str], settings: SearchSettings
) -> _Comparison:
    gain, parameters = effect_wald_statistic(fit, effect)
    if gain < settings.selection.strong_gain:
        reduced = refit_without_effect(fit, effect, batches, settings.fit)
        gain = reduced.chi2 - fit.chi2
        near = _near_alternatives(reduced, effect, batches, gain, settings)
        starts = [(score.candidate.label, start_scored_candidate(reduced, score, batches, settings)) for score in near]
    else:
        starts = _start_named_alternatives(fit, effect, batches, names, settings)
    refits = _fit_alternatives(fit, starts, batches, settings)
    tolerance = settings.indistinguishable_chi2
    equivalent = tuple(label for label, refit in refits.items() if refit.chi2 - fit.chi2 <= tolerance)
    support = EffectSupport(gain, parameters, equivalent)
    return _Comparison(support, refits, _better_alternative(fit, effect, refits, settings))


def _better_alternative(
    fit: Fit, effect: PlacedEffect, refits: Mapping[str, Fit], settings: SearchSettings
) -> str | None:
    """The alternative that gains most, less the cost of further parameters; None where the effect is as good."""
    count = len(parameters_of_interest(effect.parameters))
    gains = {}
    for label, refit in refits.items():
        placed = next(item for item in declared_effects(refit.geometry) if item.label == label)
        further = max(len(parameters_of_interest(placed.parameters)) - count, 0)
        gains[label] = fit.chi2 - refit.chi2 - settings.parameter_cost * further
    best = max(gains, key=lambda label: gains[label], default=None)
    return best if best is not None and gains[best] > settings.indistinguishable_chi2 else None


def _replacement_trials(number: int, label: str, better: str, gain: float, parameters: int) -> tuple[Trial, Trial]:
    """The trials of the effect that was removed, and of the one that replaced it."""
    return (
        refit_trial(number, label, -gain, "removed", f"{better} explains more in its place", parameters),
        refit_trial(number, better, gain, "accepted", f"explains more than {label}", parameters),
    )


# ---- refits of alternatives ------------------------------------------------------------------------------------------


def _near_alternatives(
    reduced: Fit, effect: PlacedEffect, batches: Sequence[Batch], loss: float, settings: SearchSettings
) -> list[Score]:
    """Candidates that score about as much as the `loss` of chi-square without the effect, the best first."""
    limits, pool = settings.selection, candidates(reduced.geometry, excluded=settings.excluded)
    scored = score_in_two_stages(reduced, batches, pool, settings)
    lowest = loss - limits.alternative_score_deficit - limits.score_inaccuracy * loss
    near = [score for score in scored if score.candidate.label != effect.label and score.gain > lowest]
    return sorted(near, key=lambda score: -score.gain)[: limits.max_alternatives]


def _fit_alternatives(
    fit: Fit, starts: Sequence[tuple[str, Estimate]], batches: Sequence[Batch], settings: SearchSettings
) -> dict[str, Fit]:
    """The best refit of each label from its starts; those far from the fit or the best one are not finished."""
    margin = settings.indistinguishable_chi2
    refits = fit_contenders([start for _, start in starts], batches, fit.chi2 + margin, margin, settings.fit)
    best: dict[str, Fit] = {}
    for (label, _), refit in zip(starts, refits, strict=True):
        if label not in best or refit.chi2 < best[label].chi2:
            best[label] = refit
    return best


def _start_named_alternatives(
    fit: Fit, effect: PlacedEffect, batches: Sequence[Batch], names: Sequence[str], settings: SearchSettings
) -> list[tuple[str, Estimate]]:
    """The label of each of these alternatives, and the model with it in the effect's place, at each of its starts."""
    possible = {item.label: item for item in candidates(without_effect(fit.geometry, effect))}
    labels = [name for name in names if name in possible and name != effect.label]
    labels = labels[: settings.selection.max_alternatives]
    return [
        (label, start)
        for label in labels
        for start in _starts_in_place(fit, effect, possible[label], batches, settings)
    ]


def _starts_in_place(
    fit: Fit, effect: PlacedEffect, alternative: Candidate, batches: Sequence[Batch], settings: SearchSettings
) -> list[Estimate]:
    """The model with an alternative in the place of an effect, at each of its starts."""
    others = without_effect(fit.geometry, effect)
    (placed,) = place_mass_candidates([alternative], extend_model(fit, others), batches, settings)
    if placed.fitted_start_values:
        return [refine_point_mass(extend_model(fit, add_candidates(others, [(placed, 0)])), batches, settings)]
    return [
        extend_model(fit, add_candidates(others, [(placed, number)], at_start_values=True))
        for number in range(len(placed.starts))
    ]
