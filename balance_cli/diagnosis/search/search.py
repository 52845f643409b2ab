"""The search: while the model is wrong, add the effect that takes most off its error; begin anew where it is stuck.

Every fit here has a model error (see `estimation.model_error`), so that the ranking does not rest on the noise alone.
The search ends when no candidate lowers -2 ln likelihood on the lines that were fitted and on those that were not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.result import Trial
from balance_cli.diagnosis.search.candidates import Candidate, candidates
from balance_cli.diagnosis.search.initial_candidates import InitialCandidates
from balance_cli.diagnosis.search.point_mass import place_mass_candidates
from balance_cli.diagnosis.search.preference import choose_most_linear
from balance_cli.diagnosis.search.refit import (
    PENALTY,
    PartialFit,
    SearchState,
    data_count,
    fit_partially,
    fit_until_stable,
    fit_with_candidate,
    restart,
)
from balance_cli.diagnosis.search.score_statistics import Score, scores
from balance_cli.diagnosis.search.search_lines import SearchLines
from balance_cli.diagnosis.search.trials import make_trial
from balance_cli.estimation.measurements import WORKERS
from balance_cli.estimation.model_error import add_model_error
from balance_cli.model.balance import BalanceModel

Array = NDArray[np.float64]

# Leading candidates of a round that are refitted, and the share of the best score that makes one worth it.
MAX_LEADING = 3
MIN_SCORE_SHARE = 0.2
# The same where a score rests on places or masses that nobody knows, and how many such are refitted beside the others.
NUISANCE_SEARCH_SHARE = 0.1
MAX_NUISANCE_TRIALS = 1
# A round that leaves more than this share of the model error may be in a wrong minimum.
SLOW_PROGRESS = 0.7
# Candidates that are fitted to their end, and the share of the best gain of first steps that makes one of them.
MAX_FULL_FITS = 2
MIN_PARTIAL_GAIN_SHARE = 0.7
# Largest number of effects that a search adds.
MOST_EFFECTS = 12
# A model error smaller than this share of the response is left to the tests against the noise.
SMALL_ERROR = 1e-3
LARGE_MODEL_ERROR = 3e-3
"""A model error, a share of the response, beyond which a fit may be in a wrong minimum and weights need it."""
# A share of the model error that is no progress: who goes on by such steps describes and does not explain.
MIN_PROGRESS = 0.05

Announce = Callable[[str], None]


@dataclass(frozen=True)
class SearchResult:
    """Where the search ended, what it tried, and for each effect the gains of the rivals in its round."""

    state: SearchState
    trials: tuple[Trial, ...]
    alternatives: dict[str, dict[str, float]]


def search(
    model: BalanceModel, theta: Array, lines: SearchLines, announce: Announce, known: Sequence[InitialCandidates] = ()
) -> SearchResult:
    """Add effects one by one until none helps; where the error stays large, everything is once begun anew.

    What is `known` without the plate comes first.
    """
    state = fit_until_stable(model, theta, lines)
    trials: list[Trial] = []
    alternatives: dict[str, dict[str, float]] = {}
    for initial_set in known:
        state = _add_initial_candidate(state, initial_set, lines, trials, alternatives)
    stuck = False
    for number in range(1, MOST_EFFECTS + 1):
        if state.error < SMALL_ERROR:
            break
        announce(f"search, round {number}: model error {100 * state.error:.2g} %")
        added = search_round(state, lines, number, trials, alternatives, candidates(state.geometry))
        slow = state.error > LARGE_MODEL_ERROR and (added is None or added.error > SLOW_PROGRESS * state.error)
        state = state if added is None else added
        if slow and not stuck:
            again = restart_if_better(state, lines)
            state, stuck = again or state, again is None
            if again is not None:
                continue
        elif added is not None:
            stuck = False
        if added is None:
            break
    if state.error > LARGE_MODEL_ERROR:
        state = restart_if_better(state, lines) or state
    return SearchResult(state, tuple(trials), alternatives)


def _add_initial_candidate(
    state: SearchState,
    initial_set: InitialCandidates,
    lines: SearchLines,
    trials: list[Trial],
    alternatives: dict[str, dict[str, float]],
) -> SearchState:
    """The state with whichever of the seed's candidates suits the plate better."""
    ends = {one.label: fit_with_candidate(state, one, lines) for one in initial_set.candidates}
    best = min(ends, key=lambda label: ends[label].fitted)
    for one in initial_set.candidates:
        chosen = one.label == best
        gain = state.fitted - ends[one.label].fitted - PENALTY
        why = "two channels of one cell differ so" if chosen else "another suits the plate better"
        decision = "accepted" if chosen else "rejected"
        trials.append(Trial(0, one.label, initial_set.gain, 1, 0.0, gain, decision, why))
    alternatives[best] = {label: state.fitted - end.fitted for label, end in ends.items()}
    return ends[best]


def search_round(
    state: SearchState,
    lines: SearchLines,
    number: int,
    trials: list[Trial],
    alternatives: dict[str, dict[str, float]],
    pool: Sequence[Candidate],
) -> SearchState | None:
    """The state with the best candidate of one round, put down in `trials` and `rivals`; None where none helps."""
    ranked = rank_candidates(state, lines, pool)
    first = select_leading(ranked)
    with ThreadPoolExecutor(WORKERS) as workers:
        partial_fits = list(
            zip(first, workers.map(lambda score: fit_partially(state, score, lines), first), strict=True)
        )
    tried = [
        (score, fit_until_stable(one.model, one.theta, lines, state.shares))
        for score, one in _select_for_full_fit(partial_fits)
    ]
    if not tried:
        return None
    worth = [state.fitted - new.fitted - PENALTY * score.parameters for score, new in tried]
    best_score, best = tried[choose_most_linear([new.model for _, new in tried], worth)]
    gains = {score.candidate.label: gain for (score, _), gain in zip(tried, worth, strict=True)}
    label = best_score.candidate.label
    least = _min_gain(lines, len(ranked))
    accepted = gains[label] > least and best.folds < state.folds
    folds = {score.candidate.label: state.folds - new.folds for score, new in tried}
    for score, one in partial_fits:
        name = score.candidate.label
        chosen = accepted and score is best_score
        why = (
            "gained less in its first steps"
            if name not in folds
            else _decision_reason(gains[name], least, folds[name], chosen)
        )
        gain, fold = gains.get(name, one.gain), folds.get(name, float("nan"))
        trials.append(make_trial(number, score, len(ranked), gain, chosen, why, fold))
    if not accepted:
        return None
    alternatives[label] = gains
    return best


def _select_for_full_fit(partial_fits: Sequence[tuple[Score, PartialFit]]) -> list[tuple[Score, PartialFit]]:
    """Those whose first steps gained about as much as the best one's."""
    best = max((one.gain for _, one in partial_fits), default=0.0)
    worth = [item for item in partial_fits if item[1].gain > MIN_PARTIAL_GAIN_SHARE * best > 0.0]
    return sorted(worth, key=lambda item: -item[1].gain)[:MAX_FULL_FITS]


def _min_gain(lines: SearchLines, count: int) -> float:
    """What -2 ln likelihood must gain: more than the best of `count` by chance, and more than slight progress."""
    return float(max(2.0 * np.log(count), -2.0 * data_count(lines.fitted) * np.log1p(-MIN_PROGRESS)))


def _decision_reason(gain: float, least: float, folds: float, chosen: bool) -> str:
    if chosen:
        return ""
    if gain <= least:
        return "gains too little"
    return "another gained more" if folds > 0 else "gains nothing on lines that were not fitted"


def rank_candidates(state: SearchState, lines: SearchLines, pool: Sequence[Candidate]) -> list[Score]:
    """Scores of the candidates under the model error, best first."""
    batches = add_model_error(lines.fitted, state.shares)
    pool = place_mass_candidates([one.extra_starts(state.geometry) for one in pool], state.model, state.theta, batches)
    found = scores(state.model, state.theta, batches, pool)
    return sorted(found, key=lambda score: -score.gain)


def select_leading(ranked: Sequence[Score]) -> list[Score]:
    """The leading candidates, one place of each effect, and of those that a score may wrong the best beside them."""
    best: dict[str, Score] = {}
    for score in ranked:
        if score.gain > PENALTY * score.parameters:
            best.setdefault(score.candidate.effect.name, score)
    first = [score for score in best.values() if score.gain > MIN_SCORE_SHARE * ranked[0].gain][:MAX_LEADING]
    others = [score for score in list(best.values())[len(first) :] if _has_several_nuisance_parameters(score)]
    return (
        first + [score for score in others if score.gain > NUISANCE_SEARCH_SHARE * ranked[0].gain][:MAX_NUISANCE_TRIALS]
    )


def _has_several_nuisance_parameters(score: Score) -> bool:
    """Whether a score rests on several values that nobody knows, a place and masses, and may be far too small."""
    return sum(item.nuisance for item in score.candidate.one.parameters) > 1


def restart_if_better(state: SearchState, lines: SearchLines) -> SearchState | None:
    """The same effects, everything begun anew; None where that is no better."""
    new = restart(state, lines)
    return new if new.fitted < state.fitted - PENALTY else None
