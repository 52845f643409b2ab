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
from balance_cli.diagnosis.search.point_mass import settled_mass
from balance_cli.diagnosis.search.preference import preferred
from balance_cli.diagnosis.search.refit import PENALTY
from balance_cli.diagnosis.search.score_statistics import (
    Score,
    best_scores,
    extended,
    has_shape,
    improbability,
    stepped,
    with_candidates,
)
from balance_cli.diagnosis.search.trials import trial
from balance_cli.diagnosis.selection.cross_validation import fold_gain
from balance_cli.diagnosis.selection.effect_statistics import blur
from balance_cli.diagnosis.selection.fit import Fit, begun, excess, fitted
from balance_cli.diagnosis.selection.mains_frequency import at_best_frequency
from balance_cli.estimation.maximum_likelihood import penalised_chi2
from balance_cli.estimation.measurements import Batch
from balance_cli.estimation.starting_values import by_equations_of_motion

Array = NDArray[np.float64]

SIGNIFICANT = 0.003
"""Corrected probability below which a gain is no chance: one false alarm in three hundred campaigns."""
MOST_ROUNDS = 8
FAIR_SHARE = 0.1
"""Of the chi-square that noise does not explain, what an effect must take off: any other may look a little like it."""
TOO_SLIGHT = "takes too little off what no noise explains"
BLURRED = "gains no more than what is not exactly known of "
STRONG = 1e3
"""Gain of chi-square beyond which an effect needs no refit without it to show that it is there."""
# Candidates of a round that are refitted, and how near the best score they come, that a refit may turn them round.
MOST_REFITS = 4
NEAR_BEST = 12.0
# What a score must be of the best one's where it rests on a place or a mass that nobody knows; how many such are begun.
SHAPED = 0.2
MOST_SHAPED = 2

Say = Callable[[str], None]


@dataclass(frozen=True)
class Confirmed:
    """The fit with what was added, the scores at its end, and by label how much more chi-square each rival left.

    `left`: the smallest corrected probability of a candidate that did not turn out to be chance.
    """

    fit: Fit
    trials: tuple[Trial, ...]
    scores: tuple[Score, ...]
    rivals: dict[str, dict[str, float]]
    left: float


def confirm(fit: Fit, batches: Sequence[Batch], noise_alone: bool, first_round: int, say: Say) -> Confirmed:
    """Add what is significant, one by one, as long as it takes a fair share off what noise does not explain."""
    trials: list[Trial] = []
    rivals: dict[str, dict[str, float]] = {}
    refused: set[str] = set()
    found: tuple[Score, ...] = ()
    left = 1.0
    for number in range(first_round, first_round + MOST_ROUNDS):
        say(f"all lines, round {number}")
        found = best_scores(fit.model, fit.theta, batches, candidates(fit.model.geometry))
        possible = [score for score in found if score.candidate.label not in refused]
        blurred, behind = blur(fit, batches)
        open_ones = [score for score in possible if score.gain > blurred]
        left = min(
            (chance(score.gain, score.parameters, len(found), score.noise_dof) for score in open_ones), default=1.0
        )
        chosen = significant(open_ones, len(found))
        if not chosen:
            unclear = significant([score for score in possible if score.gain <= blurred], len(found))
            trials += [trial(number, score, len(found), float("nan"), False, BLURRED + behind) for score in unclear]
            break
        least = FAIR_SHARE * excess(fit, batches, noise_alone)
        if max(score.gain for score in chosen) < least:
            trials += [trial(number, score, len(found), float("nan"), False, TOO_SLIGHT) for score in chosen]
            break
        known = _shaped(fit, open_ones, chosen, batches)
        chosen += [score for score in open_ones if score.candidate.label in known]
        tried = [_refitted(fit, score, batches, known.get(score.candidate.label)) for score in chosen]
        best = _best(fit, chosen, tried)
        folds = fold_gain(fit.model, fit.theta, batches, chosen[best])
        why = _refusal(chosen[best], fit.chi2 - tried[best].chi2, folds, least, len(found))
        for i, (score, new) in enumerate(zip(chosen, tried, strict=True)):
            judged, said = (folds, why) if i == best else (float("nan"), "another gained more")
            trials.append(trial(number, score, len(found), fit.chi2 - new.chi2, not said, said, judged))
        if why == TOO_SLIGHT:
            break
        if why:
            refused.update(score.candidate.label for score in chosen)
            continue
        others = {score.candidate.label: new.chi2 - tried[best].chi2 for score, new in zip(chosen, tried, strict=True)}
        label = chosen[best].candidate.label
        rivals[label] = {name: gap for name, gap in others.items() if name != label}
        fit = tried[best]
    return Confirmed(fit, tuple(trials), found, rivals, left)


def _shaped(fit: Fit, found: Sequence[Score], chosen: Sequence[Score], batches: Sequence[Batch]) -> dict[str, Fit]:
    """Further candidates that a score wrongs, for what shapes them was anywhere: those whose first steps gain as much.

    By label, where these steps led.
    """
    least, taken = min(score.gain for score in chosen), {score.candidate.label for score in chosen}
    shaped = [score for score in found if score.candidate.label not in taken and has_shape(score)]
    shaped = [score for score in shaped if score.gain > SHAPED * chosen[0].gain and score.p_value < SIGNIFICANT]
    worth = {}
    for score in sorted(shaped, key=lambda score: -score.gain)[:MOST_SHAPED]:
        first = _first_steps(fit, score, batches)
        if fit.chi2 - first.chi2 - PENALTY * score.parameters > least:
            worth[score.candidate.label] = first
    return worth


def _first_steps(fit: Fit, score: Score, batches: Sequence[Batch]) -> Fit:
    """The candidate begun at its score's step, and where the equations of motion lead from there; a mass, at its

    best place.
    """
    if score.candidate.chosen:
        geometry = with_candidates(fit.model.geometry, [(score.candidate, score.start)])
        model, null = extended(fit.model, fit.theta, geometry)
        return begun(model, settled_mass(model, null, batches), batches)
    model, near = stepped(fit.model, fit.theta, batches, score)
    regressed = by_equations_of_motion(model.parameters, batches, model.system, near)
    starts = [near, regressed] if np.isfinite(penalised_chi2(model, regressed, batches)) else [near]
    return min((begun(model, start, batches) for start in starts), key=lambda end: end.chi2)


def _best(fit: Fit, chosen: Sequence[Score], tried: Sequence[Fit]) -> int:
    """Which of the candidates that were refitted is worth most."""
    worth = [fit.chi2 - new.chi2 - PENALTY * score.parameters for score, new in zip(chosen, tried, strict=True)]
    return preferred([new.model for new in tried], worth)


def _refusal(score: Score, gain: float, folds: float, least: float, count: int) -> str:
    """Why the best candidate is not accepted; empty where it is."""
    if chance(gain, score.parameters, count, score.noise_dof) >= SIGNIFICANT:
        return "chance would gain as much"
    # NaN: all that is known of it is in one place, and nothing else can speak for or against it.
    if folds <= 0:
        return "gains nothing on lines that its step had not seen"
    return TOO_SLIGHT if gain < least else ""


def significant(found: Sequence[Score], count: int) -> list[Score]:
    """The best candidates by what they would gain less their price, where the best is significant at all."""
    worth = sorted(found, key=lambda score: PENALTY * score.parameters - score.gain)
    if not worth or chance(worth[0].gain, worth[0].parameters, count, worth[0].noise_dof) >= SIGNIFICANT:
        return []
    best = worth[0].gain - PENALTY * worth[0].parameters
    near = [score for score in worth if score.gain - PENALTY * score.parameters > best - NEAR_BEST - 0.1 * best]
    return near[:MOST_REFITS]


def chance(gain: float, parameters: int, count: int, noise_dof: float = np.inf) -> float:
    """Probability that the best of `count` candidates gains so much where nothing is missing (Bonferroni)."""
    return min(1.0, count * improbability(gain, parameters, noise_dof))


def _refitted(fit: Fit, score: Score, batches: Sequence[Batch], first: Fit | None) -> Fit:
    """The fit with a candidate added, from its `first` steps; where its score is no small one, from its start too.

    Where no fit comes to an end, in a valley, it is tried once more from the side.
    """
    if not has_shape(score):
        return fitted(*stepped(fit.model, fit.theta, batches, score), batches)
    first = _first_steps(fit, score, batches) if first is None else first
    near = fitted(first.model, first.theta, batches)
    if score.gain < STRONG or score.candidate.chosen:
        return at_best_frequency(near, [score.candidate.one], batches)
    geometry = with_candidates(fit.model.geometry, [(score.candidate, score.start)], started=True)
    far = fitted(*extended(fit.model, fit.theta, geometry), batches)
    best = min(near, far, key=lambda end: end.chi2)
    if not best.minimum.converged:
        best = min(best, _shaped_last(fit, score, batches), key=lambda end: end.chi2)
    return at_best_frequency(best, [score.candidate.one], batches)


def _shaped_last(fit: Fit, score: Score, batches: Sequence[Batch]) -> Fit:
    """The fit with what shapes a candidate held at first: until all else is where it belongs, that leads far away."""
    model, near = stepped(fit.model, fit.theta, batches, score)
    one, names = score.candidate.one, model.parameters.names
    shape = {one.full_name(item) for item in one.parameters if item.secondary}
    sigma = [0.0 if name in shape else known for name, known in zip(names, model.parameters.sigma, strict=True)]
    return fitted(model, fitted(model.with_sigma(np.array(sigma)), near, batches).theta, batches)
