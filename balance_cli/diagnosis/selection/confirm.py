"""Against the noise alone, with all lines: what is still missing, and what is no longer needed.

Where the search has ended (or nothing was wrong), a candidate must show more than chance allows among all that were
tried, must gain on blocks of lines that its step has not seen, and must keep its gain when everything is refitted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.result import Trial
from balance_cli.diagnosis.search.candidates import candidates
from balance_cli.diagnosis.search.point_mass import refine_point_mass
from balance_cli.diagnosis.search.preference import choose_most_linear
from balance_cli.diagnosis.search.refit import PENALTY
from balance_cli.diagnosis.search.score_statistics import (
    Score,
    add_candidates,
    apply_score_step,
    extend_model,
    gain_p_value,
    has_nuisance_parameters,
    score_in_two_stages,
)
from balance_cli.diagnosis.search.trials import make_trial
from balance_cli.diagnosis.selection.cross_validation import cross_validation_gain
from balance_cli.diagnosis.selection.effect_statistics import confounding_limit
from balance_cli.diagnosis.selection.fit import Fit, fit_all_lines, start_fit, unexplained_chi2
from balance_cli.diagnosis.selection.mains_frequency import refit_at_best_frequency
from balance_cli.estimation.maximum_likelihood import penalized_chi2
from balance_cli.estimation.measurements import Batch
from balance_cli.estimation.starting_values import start_from_equations_of_motion

Array = NDArray[np.float64]

SIGNIFICANCE_LEVEL = 0.003
"""Corrected probability below which a gain is no chance: one false alarm in three hundred campaigns."""
MOST_ROUNDS = 8
MIN_EFFECT_SHARE = 0.1
"""Of the chi-square that noise does not explain, what an effect must take off: any other may look a little like it."""
REASON_SMALL_GAIN = "takes too little off what no noise explains"
REASON_CONFOUNDED = "gains no more than what is not exactly known of "
STRONG_GAIN = 1e3
"""Gain of chi-square beyond which an effect needs no refit without it to show that it is there."""
# Candidates of a round that are refitted, and how near the best score they come, that a refit may turn them round.
MOST_REFITS = 4
NEAR_BEST = 12.0
# What a score must be of the best one's where it rests on a place or a mass that nobody knows; how many such are begun.
NUISANCE_CONFIRM_SHARE = 0.2
MAX_NUISANCE_REFITS = 2

Announce = Callable[[str], None]


@dataclass(frozen=True)
class ConfirmedFit:
    """The fit with what was added, the scores at its end, and by label how much more chi-square each rival left.

    `left`: the smallest corrected probability of a candidate that did not turn out to be chance.
    """

    fit: Fit
    trials: tuple[Trial, ...]
    scores: tuple[Score, ...]
    alternatives: dict[str, dict[str, float]]
    smallest_p_value: float


def confirm(
    fit: Fit, batches: Sequence[Batch], noise_alone: bool, first_round: int, announce: Announce
) -> ConfirmedFit:
    """Add what is significant, one by one, as long as it takes a fair share off what noise does not explain."""
    trials: list[Trial] = []
    alternatives: dict[str, dict[str, float]] = {}
    refused: set[str] = set()
    found: tuple[Score, ...] = ()
    smallest_p_value = 1.0
    for number in range(first_round, first_round + MOST_ROUNDS):
        announce(f"all lines, round {number}")
        found = score_in_two_stages(fit.model, fit.theta, batches, candidates(fit.model.geometry))
        possible = [score for score in found if score.candidate.label not in refused]
        blurred, behind = confounding_limit(fit, batches)
        open_ones = [score for score in possible if score.gain > blurred]
        smallest_p_value = min(
            (bonferroni_p_value(score.gain, score.parameters, len(found), score.noise_dof) for score in open_ones),
            default=1.0,
        )
        chosen = select_significant(open_ones, len(found))
        if not chosen:
            unclear = select_significant([score for score in possible if score.gain <= blurred], len(found))
            trials += [
                make_trial(number, score, len(found), float("nan"), False, REASON_CONFOUNDED + behind)
                for score in unclear
            ]
            break
        least = MIN_EFFECT_SHARE * unexplained_chi2(fit, batches, noise_alone)
        if max(score.gain for score in chosen) < least:
            trials += [
                make_trial(number, score, len(found), float("nan"), False, REASON_SMALL_GAIN) for score in chosen
            ]
            break
        known = _nuisance_candidates(fit, open_ones, chosen, batches)
        chosen += [score for score in open_ones if score.candidate.label in known]
        tried = [_refit_with_candidate(fit, score, batches, known.get(score.candidate.label)) for score in chosen]
        best = _best_refit(fit, chosen, tried)
        folds = cross_validation_gain(fit.model, fit.theta, batches, chosen[best])
        why = _rejection_reason(chosen[best], fit.chi2 - tried[best].chi2, folds, least, len(found))
        for i, (score, new) in enumerate(zip(chosen, tried, strict=True)):
            judged, said = (folds, why) if i == best else (float("nan"), "another gained more")
            trials.append(make_trial(number, score, len(found), fit.chi2 - new.chi2, not said, said, judged))
        if why == REASON_SMALL_GAIN:
            break
        if why:
            refused.update(score.candidate.label for score in chosen)
            continue
        others = {score.candidate.label: new.chi2 - tried[best].chi2 for score, new in zip(chosen, tried, strict=True)}
        label = chosen[best].candidate.label
        alternatives[label] = {name: gap for name, gap in others.items() if name != label}
        fit = tried[best]
    return ConfirmedFit(fit, tuple(trials), found, alternatives, smallest_p_value)


def _nuisance_candidates(
    fit: Fit, found: Sequence[Score], chosen: Sequence[Score], batches: Sequence[Batch]
) -> dict[str, Fit]:
    """Further candidates that a score wrongs, for what shapes them was anywhere: those whose first steps gain as much.

    By label, where these steps led.
    """
    least, taken = min(score.gain for score in chosen), {score.candidate.label for score in chosen}
    shaped = [score for score in found if score.candidate.label not in taken and has_nuisance_parameters(score)]
    shaped = [
        score
        for score in shaped
        if score.gain > NUISANCE_CONFIRM_SHARE * chosen[0].gain and score.p_value < SIGNIFICANCE_LEVEL
    ]
    worth = {}
    for score in sorted(shaped, key=lambda score: -score.gain)[:MAX_NUISANCE_REFITS]:
        first = _fit_first_steps(fit, score, batches)
        if fit.chi2 - first.chi2 - PENALTY * score.parameters > least:
            worth[score.candidate.label] = first
    return worth


def _fit_first_steps(fit: Fit, score: Score, batches: Sequence[Batch]) -> Fit:
    """The candidate begun at its score's step, and where the equations of motion lead from there; a mass, at its

    best place.
    """
    if score.candidate.chosen:
        geometry = add_candidates(fit.model.geometry, [(score.candidate, score.start)])
        model, null = extend_model(fit.model, fit.theta, geometry)
        return start_fit(model, refine_point_mass(model, null, batches), batches)
    model, near = apply_score_step(fit.model, fit.theta, batches, score)
    regressed = start_from_equations_of_motion(model.parameters, batches, model.system, near)
    starts = [near, regressed] if np.isfinite(penalized_chi2(model, regressed, batches)) else [near]
    return min((start_fit(model, start, batches) for start in starts), key=lambda end: end.chi2)


def _best_refit(fit: Fit, chosen: Sequence[Score], tried: Sequence[Fit]) -> int:
    """Which of the candidates that were refitted is worth most."""
    worth = [fit.chi2 - new.chi2 - PENALTY * score.parameters for score, new in zip(chosen, tried, strict=True)]
    return choose_most_linear([new.model for new in tried], worth)


def _rejection_reason(score: Score, gain: float, folds: float, least: float, count: int) -> str:
    """Why the best candidate is not accepted; empty where it is."""
    if bonferroni_p_value(gain, score.parameters, count, score.noise_dof) >= SIGNIFICANCE_LEVEL:
        return "chance would gain as much"
    # NaN: all that is known of it is in one place, and nothing else can speak for or against it.
    if folds <= 0:
        return "gains nothing on lines that its step had not seen"
    return REASON_SMALL_GAIN if gain < least else ""


def select_significant(found: Sequence[Score], count: int) -> list[Score]:
    """The best candidates by what they would gain less their price, where the best is significant at all."""
    worth = sorted(found, key=lambda score: PENALTY * score.parameters - score.gain)
    if (
        not worth
        or bonferroni_p_value(worth[0].gain, worth[0].parameters, count, worth[0].noise_dof) >= SIGNIFICANCE_LEVEL
    ):
        return []
    best = worth[0].gain - PENALTY * worth[0].parameters
    near = [score for score in worth if score.gain - PENALTY * score.parameters > best - NEAR_BEST - 0.1 * best]
    return near[:MOST_REFITS]


def bonferroni_p_value(gain: float, parameters: int, count: int, noise_dof: float = np.inf) -> float:
    """Probability that the best of `count` candidates gains so much where nothing is missing (Bonferroni)."""
    return min(1.0, count * gain_p_value(gain, parameters, noise_dof))


def _refit_with_candidate(fit: Fit, score: Score, batches: Sequence[Batch], first: Fit | None) -> Fit:
    """The fit with a candidate added, from its `first` steps; where its score is no small one, from its start too.

    Where no fit comes to an end, in a valley, it is tried once more from the side.
    """
    if not has_nuisance_parameters(score):
        return fit_all_lines(*apply_score_step(fit.model, fit.theta, batches, score), batches)
    first = _fit_first_steps(fit, score, batches) if first is None else first
    near = fit_all_lines(first.model, first.theta, batches)
    if score.gain < STRONG_GAIN or score.candidate.chosen:
        return refit_at_best_frequency(near, [score.candidate.one], batches)
    geometry = add_candidates(fit.model.geometry, [(score.candidate, score.start)], at_start_values=True)
    far = fit_all_lines(*extend_model(fit.model, fit.theta, geometry), batches)
    best = min(near, far, key=lambda end: end.chi2)
    if not best.minimum.converged:
        best = min(best, _fit_nuisance_last(fit, score, batches), key=lambda end: end.chi2)
    return refit_at_best_frequency(best, [score.candidate.one], batches)


def _fit_nuisance_last(fit: Fit, score: Score, batches: Sequence[Batch]) -> Fit:
    """The fit with what shapes a candidate held at first: until all else is where it belongs, that leads far away."""
    model, near = apply_score_step(fit.model, fit.theta, batches, score)
    one, names = score.candidate.one, model.parameters.names
    shape = {one.full_name(item) for item in one.parameters if item.nuisance}
    sigma = [0.0 if name in shape else known for name, known in zip(names, model.parameters.sigma, strict=True)]
    return fit_all_lines(model, fit_all_lines(model.with_sigma(np.array(sigma)), near, batches).theta, batches)
