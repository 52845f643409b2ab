"""What would do as well in an effect's place, and what does better: sets that the data cannot tell apart."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

from balance_cli.diagnosis.result import Trial
from balance_cli.diagnosis.search.candidates import Candidate, candidates, parameters_of_interest
from balance_cli.diagnosis.search.point_mass import place_mass_candidates, refine_point_mass
from balance_cli.diagnosis.search.preference import INDISTINGUISHABLE_CHI2
from balance_cli.diagnosis.search.refit import PENALTY
from balance_cli.diagnosis.search.score_statistics import (
    Score,
    add_candidates,
    apply_score_step,
    extend_model,
    score_in_two_stages,
)
from balance_cli.diagnosis.selection.confirm import STRONG_GAIN
from balance_cli.diagnosis.selection.effect_selection import prune_effects, refit_without_effect, without_effect
from balance_cli.diagnosis.selection.effect_statistics import effect_wald_statistic
from balance_cli.diagnosis.selection.fit import Fit, fit_all_lines
from balance_cli.estimation.measurements import Batch
from balance_cli.model.placed_effects import PlacedEffect, declared_effects

# Rivals of an effect that are refitted, and how far the scores of a weak one's may fall short of its own.
MAX_ALTERNATIVES = 4
MAX_SCORE_DEFICIT = 8.0
MOST_REPLACED = 6


@dataclass(frozen=True)
class EffectSupport:
    """What an effect of the closed model gains in chi-square, for how many known parameters, and what does as well."""

    gain: float
    parameters: int
    alike: tuple[str, ...]


@dataclass(frozen=True)
class ComparisonResult:
    """The fit with the better of each effect and its rivals, where each then stands, and what was put in its place."""

    fit: Fit
    effect_support: dict[str, EffectSupport]
    trials: tuple[Trial, ...]


def compare_alternatives(
    fit: Fit,
    batches: Sequence[Batch],
    given_labels: Collection[str],
    alternatives: Mapping[str, Sequence[str]],
    count: int,
    number: int,
    announce: Callable[[str], None],
) -> ComparisonResult:
    """Every effect that is not `given` against its rivals: those of its round (labels), or of a weak one all.

    A rival takes the place of an effect where it explains more than can be chance or its parameters can make. What it
    makes needless goes, and all are looked at once more: two small effects may have stood for one of many parameters.
    """
    alternatives, trials = dict(alternatives), list[Trial]()
    effect_support: dict[str, EffectSupport] = {}
    while label := next(
        (one.label for one in _added_effects(fit, given_labels) if one.label not in effect_support), None
    ):
        announce(f"evidence of {label}")
        one = _effect_by_label(fit, label)
        gain, known = effect_wald_statistic(fit, one)
        less = refit_without_effect(fit, one, batches) if gain < STRONG_GAIN else None
        ends = _fit_alternatives(fit, one, batches, alternatives.get(label, ()), less)
        better = _better_alternative(fit, one, ends)
        if better is None or len(trials) >= 2 * MOST_REPLACED:
            gain = gain if less is None else less.chi2 - fit.chi2
            alike = tuple(name for name, end in ends.items() if end.chi2 - fit.chi2 <= INDISTINGUISHABLE_CHI2)
            effect_support[label] = EffectSupport(gain, known, alike)
            continue
        trials += _replacement_trials(number, one, better, fit.chi2 - ends[better].chi2, known)
        alternatives[better] = (label, *alternatives.get(label, ()))
        fit, removed = prune_effects(ends[better], batches, count, number)
        trials += removed
        effect_support.clear()
    return ComparisonResult(fit, effect_support, tuple(trials))


def _added_effects(fit: Fit, given_labels: Collection[str]) -> list[PlacedEffect]:
    return [one for one in declared_effects(fit.model.geometry) if one.label not in given_labels]


def _effect_by_label(fit: Fit, label: str) -> PlacedEffect:
    return next(one for one in declared_effects(fit.model.geometry) if one.label == label)


def _fit_alternatives(
    fit: Fit, one: PlacedEffect, batches: Sequence[Batch], names: Sequence[str], less: Fit | None
) -> dict[str, Fit]:
    """The fits with rivals in the effect's place. `less`: the model without a weak one, whose scores name them."""
    if less is not None:
        near = _near_alternatives(less, one, batches, less.chi2 - fit.chi2)[:MAX_ALTERNATIVES]
        return {item.candidate.label: _fit_scored_candidate(less, item, batches) for item in near}
    possible = {item.label: item for item in candidates(without_effect(fit.model.geometry, one))}
    known = [name for name in names if name in possible and name != one.label][:MAX_ALTERNATIVES]
    return {name: _fit_in_place(fit, one, possible[name], batches) for name in known}


def _better_alternative(fit: Fit, one: PlacedEffect, ends: Mapping[str, Fit]) -> str | None:
    """The rival that explains most, each parameter paid for; None where the effect itself is as good."""
    own = len(parameters_of_interest(one.parameters))
    worth = {
        label: fit.chi2
        - end.chi2
        - PENALTY * max(len(parameters_of_interest(_effect_by_label(end, label).parameters)) - own, 0)
        for label, end in ends.items()
    }
    best = max(worth, key=lambda label: worth[label], default=None)
    return best if best is not None and worth[best] > INDISTINGUISHABLE_CHI2 else None


def _replacement_trials(number: int, one: PlacedEffect, better: str, gain: float, known: int) -> tuple[Trial, Trial]:
    """Both put down: what came in, and what had to go."""
    nan = float("nan")
    return (
        Trial(number, one.label, nan, known, 1.0, -gain, "removed", f"{better} explains more in its place"),
        Trial(number, better, nan, known, 1.0, gain, "accepted", f"explains more than {one.label}"),
    )


def _fit_scored_candidate(less: Fit, score: Score, batches: Sequence[Batch]) -> Fit:
    """A candidate fitted from its score's step, or, a mass, from its best place."""
    if not score.candidate.chosen:
        return fit_all_lines(*apply_score_step(less.model, less.theta, batches, score), batches)
    geometry = add_candidates(less.model.geometry, [(score.candidate, score.start)])
    model, null = extend_model(less.model, less.theta, geometry)
    return fit_all_lines(model, refine_point_mass(model, null, batches), batches)


def _fit_in_place(fit: Fit, one: PlacedEffect, alternative: Candidate, batches: Sequence[Batch]) -> Fit:
    """The model with a rival in the place of an effect, refitted from the best of its starts."""
    others = without_effect(fit.model.geometry, one)
    (alternative,) = place_mass_candidates([alternative], *extend_model(fit.model, fit.theta, others), batches)
    if alternative.chosen:
        model, null = extend_model(fit.model, fit.theta, add_candidates(others, [(alternative, 0)]))
        return fit_all_lines(model, refine_point_mass(model, null, batches), batches)
    fits = []
    for number in range(len(alternative.starts)):
        model, theta = extend_model(
            fit.model, fit.theta, add_candidates(others, [(alternative, number)], at_start_values=True)
        )
        fits.append(fit_all_lines(model, theta, batches))
    return min(fits, key=lambda item: item.chi2)


def _near_alternatives(less: Fit, one: PlacedEffect, batches: Sequence[Batch], lost: float) -> list[Score]:
    """Candidates that score about as well as what was lost with the effect, the best first."""
    found = score_in_two_stages(less.model, less.theta, batches, candidates(less.model.geometry))
    near = [
        item
        for item in found
        if item.candidate.label != one.label and item.gain > lost - MAX_SCORE_DEFICIT - 0.1 * lost
    ]
    return sorted(near, key=lambda item: -item.gain)
