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
from balance_cli.diagnosis.search.initial_candidates import Seed
from balance_cli.diagnosis.search.point_mass import well_placed
from balance_cli.diagnosis.search.preference import preferred
from balance_cli.diagnosis.search.refit import (
    PENALTY,
    Attempt,
    State,
    attempt,
    begun_anew,
    data_count,
    settled,
    with_candidate,
)
from balance_cli.diagnosis.search.score_statistics import Score, scores
from balance_cli.diagnosis.search.search_lines import SearchLines
from balance_cli.diagnosis.search.trials import trial
from balance_cli.estimation.measurements import WORKERS
from balance_cli.estimation.model_error import with_model_error
from balance_cli.model.balance import BalanceModel

Array = NDArray[np.float64]

# Leading candidates of a round that are refitted, and the share of the best score that makes one worth it.
LEADING = 3
WORTH_IT = 0.2
# The same where a score rests on places or masses that nobody knows, and how many such are refitted beside the others.
SHAPED = 0.1
MOST_SHAPED = 1
# A round that leaves more than this share of the model error may be in a wrong minimum.
SLOW = 0.7
# Candidates that are fitted to their end, and the share of the best gain of first steps that makes one of them.
MOST_SETTLED = 2
ABOUT_AS_MUCH = 0.7
# Largest number of effects that a search adds.
MOST_EFFECTS = 12
# A model error smaller than this share of the response is left to the tests against the noise.
SMALL_ERROR = 1e-3
WRONG = 3e-3
"""A model error, a share of the response, beyond which a fit may be in a wrong minimum and weights need it."""
# A share of the model error that is no progress: who goes on by such steps describes and does not explain.
SLIGHT = 0.05

Say = Callable[[str], None]


@dataclass(frozen=True)
class Found:
    """Where the search ended, what it tried, and for each effect the gains of the rivals in its round."""

    state: State
    trials: tuple[Trial, ...]
    rivals: dict[str, dict[str, float]]


def search(model: BalanceModel, theta: Array, lines: SearchLines, say: Say, known: Sequence[Seed] = ()) -> Found:
    """Add effects one by one until none helps; where the error stays large, everything is once begun anew.

    What is `known` without the plate comes first.
    """
    state = settled(model, theta, lines)
    trials: list[Trial] = []
    rivals: dict[str, dict[str, float]] = {}
    for seed in known:
        state = _sown(state, seed, lines, trials, rivals)
    stuck = False
    for number in range(1, MOST_EFFECTS + 1):
        if state.error < SMALL_ERROR:
            break
        say(f"search, round {number}: model error {100 * state.error:.2g} %")
        added = search_round(state, lines, number, trials, rivals, candidates(state.geometry))
        slow = state.error > WRONG and (added is None or added.error > SLOW * state.error)
        state = state if added is None else added
        if slow and not stuck:
            again = started_again(state, lines)
            state, stuck = again or state, again is None
            if again is not None:
                continue
        elif added is not None:
            stuck = False
        if added is None:
            break
    if state.error > WRONG:
        state = started_again(state, lines) or state
    return Found(state, tuple(trials), rivals)


def _sown(
    state: State, seed: Seed, lines: SearchLines, trials: list[Trial], rivals: dict[str, dict[str, float]]
) -> State:
    """The state with whichever of the seed's candidates suits the plate better."""
    ends = {one.label: with_candidate(state, one, lines) for one in seed.candidates}
    best = min(ends, key=lambda label: ends[label].fitted)
    for one in seed.candidates:
        chosen = one.label == best
        gain = state.fitted - ends[one.label].fitted - PENALTY
        why = "two channels of one cell differ so" if chosen else "another suits the plate better"
        decision = "accepted" if chosen else "rejected"
        trials.append(Trial(0, one.label, seed.gain, 1, 0.0, gain, decision, why))
    rivals[best] = {label: state.fitted - end.fitted for label, end in ends.items()}
    return ends[best]


def search_round(
    state: State,
    lines: SearchLines,
    number: int,
    trials: list[Trial],
    rivals: dict[str, dict[str, float]],
    pool: Sequence[Candidate],
) -> State | None:
    """The state with the best candidate of one round, put down in `trials` and `rivals`; None where none helps."""
    ranked = ranked_scores(state, lines, pool)
    first = leading(ranked)
    with ThreadPoolExecutor(WORKERS) as workers:
        begun = list(zip(first, workers.map(lambda score: attempt(state, score, lines), first), strict=True))
    tried = [(score, settled(one.model, one.theta, lines, state.shares)) for score, one in _worth_settling(begun)]
    if not tried:
        return None
    worth = [state.fitted - new.fitted - PENALTY * score.parameters for score, new in tried]
    best_score, best = tried[preferred([new.model for _, new in tried], worth)]
    gains = {score.candidate.label: gain for (score, _), gain in zip(tried, worth, strict=True)}
    label = best_score.candidate.label
    least = _least(lines, len(ranked))
    accepted = gains[label] > least and best.folds < state.folds
    folds = {score.candidate.label: state.folds - new.folds for score, new in tried}
    for score, one in begun:
        name = score.candidate.label
        chosen = accepted and score is best_score
        why = "gained less in its first steps" if name not in folds else _why(gains[name], least, folds[name], chosen)
        gain, fold = gains.get(name, one.gain), folds.get(name, float("nan"))
        trials.append(trial(number, score, len(ranked), gain, chosen, why, fold))
    if not accepted:
        return None
    rivals[label] = gains
    return best


def _worth_settling(begun: Sequence[tuple[Score, Attempt]]) -> list[tuple[Score, Attempt]]:
    """Those whose first steps gained about as much as the best one's."""
    best = max((one.gain for _, one in begun), default=0.0)
    worth = [item for item in begun if item[1].gain > ABOUT_AS_MUCH * best > 0.0]
    return sorted(worth, key=lambda item: -item[1].gain)[:MOST_SETTLED]


def _least(lines: SearchLines, count: int) -> float:
    """What -2 ln likelihood must gain: more than the best of `count` by chance, and more than slight progress."""
    return float(max(2.0 * np.log(count), -2.0 * data_count(lines.fitted) * np.log1p(-SLIGHT)))


def _why(gain: float, least: float, folds: float, chosen: bool) -> str:
    if chosen:
        return ""
    if gain <= least:
        return "gains too little"
    return "another gained more" if folds > 0 else "gains nothing on lines that were not fitted"


def ranked_scores(state: State, lines: SearchLines, pool: Sequence[Candidate]) -> list[Score]:
    """Scores of the candidates under the model error, best first."""
    batches = with_model_error(lines.fitted, state.shares)
    pool = well_placed([one.scanned(state.geometry) for one in pool], state.model, state.theta, batches)
    found = scores(state.model, state.theta, batches, pool)
    return sorted(found, key=lambda score: -score.gain)


def leading(ranked: Sequence[Score]) -> list[Score]:
    """The leading candidates, one place of each effect, and of those that a score may wrong the best beside them."""
    best: dict[str, Score] = {}
    for score in ranked:
        if score.gain > PENALTY * score.parameters:
            best.setdefault(score.candidate.effect.name, score)
    first = [score for score in best.values() if score.gain > WORTH_IT * ranked[0].gain][:LEADING]
    others = [score for score in list(best.values())[len(first) :] if _wronged(score)]
    return first + [score for score in others if score.gain > SHAPED * ranked[0].gain][:MOST_SHAPED]


def _wronged(score: Score) -> bool:
    """Whether a score rests on several values that nobody knows, a place and masses, and may be far too small."""
    return sum(item.secondary for item in score.candidate.one.parameters) > 1


def started_again(state: State, lines: SearchLines) -> State | None:
    """The same effects, everything begun anew; None where that is no better."""
    new = begun_anew(state, lines)
    return new if new.fitted < state.fitted - PENALTY else None
