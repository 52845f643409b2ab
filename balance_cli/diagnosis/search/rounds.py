"""One round of the search: rank the candidates by score, refit the leading ones, and accept the best one or none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from balance_cli.diagnosis.result import Trial
from balance_cli.diagnosis.search.candidates import Candidate
from balance_cli.diagnosis.search.point_mass import place_mass_candidates
from balance_cli.diagnosis.search.preference import choose_most_linear
from balance_cli.diagnosis.search.refit import PartialFit, SearchState, fit_partially, fit_until_stable
from balance_cli.diagnosis.search.score_statistics import Score, has_nuisance_parameters, scores
from balance_cli.diagnosis.search.search_lines import SearchLines
from balance_cli.diagnosis.search.trials import make_trial
from balance_cli.diagnosis.settings import RoundSettings, SearchSettings
from balance_cli.estimation.batch import WORKERS
from balance_cli.estimation.likelihood import count_measured_values
from balance_cli.estimation.model_error import add_model_error

PartialFits = Sequence[tuple[Score, PartialFit]]


@dataclass(frozen=True)
class RoundResult:
    """The state with the accepted candidate (None where none was), the trials, and the gains of its alternatives.

    `alternatives`: by label of the accepted candidate, the gain of every candidate that was fitted until stable.
    """

    state: SearchState | None
    trials: tuple[Trial, ...] = ()
    alternatives: dict[str, dict[str, float]] = field(default_factory=dict)


def search_round(
    state: SearchState, lines: SearchLines, number: int, pool: Sequence[Candidate], settings: SearchSettings
) -> RoundResult:
    """Return what round `number` adds to the state from a pool of candidates."""
    ranked = rank_candidates(state, lines, pool, settings)
    leading = select_leading(ranked, settings)
    partial_fits = _fit_leading(state, leading, lines, settings)
    refits = [
        (score, fit_until_stable(partial, lines, settings.fit, state.shares))
        for score, partial in _select_for_full_fit(partial_fits, settings.rounds)
    ]
    if not refits:
        return RoundResult(None)
    gains = _gains(state, refits, settings)
    terms = [end.system(derivatives=False).equations.nonlinear_terms for _, end in refits]
    best_score, best = refits[choose_most_linear(terms, list(gains.values()), settings.indistinguishable_chi2)]
    label, threshold = best_score.candidate.label, _min_gain(lines, len(ranked), settings.rounds)
    accepted = gains[label] > threshold and best.validation_criterion < state.validation_criterion
    validation = {score.candidate.label: state.validation_criterion - end.validation_criterion for score, end in refits}
    decision = _Decision(label if accepted else None, threshold, gains, validation)
    first_gains = {score.candidate.label: partial.gain for score, partial in partial_fits}
    trials = tuple(decision.trial(number, score, len(ranked), first_gains) for score in leading)
    return RoundResult(best, trials, {label: gains}) if accepted else RoundResult(None, trials)


def _fit_leading(
    state: SearchState, leading: Sequence[Score], lines: SearchLines, settings: SearchSettings
) -> PartialFits:
    """The first steps of leading candidates: first those whose scores may be far too small, then what can rival them.

    Without nuisance parameters the score predicts the gain. What is left out takes its turn in the next round.
    """
    uncertain = [score for score in leading if has_nuisance_parameters(score)]
    with ThreadPoolExecutor(WORKERS) as workers:

        def fit(scores: Sequence[Score]) -> PartialFits:
            ends = workers.map(lambda score: fit_partially(state, score, lines, settings), scores)
            return list(zip(scores, ends, strict=True))

        fits = fit(uncertain)
        least = settings.rounds.min_rival_score_share * max((partial.gain for _, partial in fits), default=0.0)
        rivals = [score for score in leading if not has_nuisance_parameters(score) and score.gain > least]
        return [*fits, *fit(rivals)]


def _gains(
    state: SearchState, refits: Sequence[tuple[Score, SearchState]], settings: SearchSettings
) -> dict[str, float]:
    """Decrease of -2 ln likelihood, less the cost of the parameters, by label."""
    return {
        score.candidate.label: state.fit_criterion - end.fit_criterion - settings.parameter_cost * score.parameters
        for score, end in refits
    }


@dataclass(frozen=True)
class _Decision:
    """The accepted label, the gain that was asked, and by label the gains on fitted and on validation lines."""

    accepted: str | None
    threshold: float
    gains: Mapping[str, float]
    validation: Mapping[str, float]

    def trial(self, number: int, score: Score, count: int, first_gains: Mapping[str, float]) -> Trial:
        """The trial of one of `count` candidates in round `number`; `first_gains` of those that took first steps."""
        label = score.candidate.label
        gain = self.gains.get(label, first_gains.get(label, float("nan")))
        validation = self.validation.get(label, float("nan"))
        reason = self._reason(label) if label in first_gains else "its score is far below what another gained"
        return make_trial(number, score, count, gain, label == self.accepted, reason, validation)

    def _reason(self, label: str) -> str:
        if label == self.accepted:
            return ""
        if label not in self.gains:
            return "gained less in its first steps"
        if self.gains[label] <= self.threshold:
            return "gains too little"
        return "another gained more" if self.validation[label] > 0 else "gains nothing on lines that were not fitted"


def _select_for_full_fit(partial_fits: PartialFits, settings: RoundSettings) -> PartialFits:
    """The candidates whose first steps gained about as much as the best one's, best first."""
    best = max((partial.gain for _, partial in partial_fits), default=0.0)
    near = [item for item in partial_fits if item[1].gain > settings.min_partial_gain_share * best > 0.0]
    return sorted(near, key=lambda item: -item[1].gain)[: settings.max_full_fits]


def _min_gain(lines: SearchLines, count: int, settings: RoundSettings) -> float:
    """Gain of -2 ln likelihood that is more than chance makes of the best of `count`, and more than slight progress."""
    progress = -2.0 * count_measured_values(lines.fitted) * np.log1p(-settings.min_progress)
    return float(max(2.0 * np.log(count), progress))


def rank_candidates(
    state: SearchState, lines: SearchLines, pool: Sequence[Candidate], settings: SearchSettings
) -> list[Score]:
    """Return the scores of the candidates under the model error, best first."""
    batches = add_model_error(lines.fitted, state.shares)
    started = [candidate.extra_starts(state.geometry) for candidate in pool]
    placed = place_mass_candidates(started, state, batches, settings)
    return sorted(scores(state, batches, placed, settings.score), key=lambda score: -score.gain)


def select_leading(ranked: Sequence[Score], settings: SearchSettings) -> list[Score]:
    """Return the leading candidates, one place of each effect, and the best one whose score may be far too small."""
    limits, best = settings.rounds, dict[str, Score]()
    for score in ranked:
        if score.gain > settings.parameter_cost * score.parameters:
            best.setdefault(score.candidate.effect.name, score)
    leading = [score for score in best.values() if score.gain > limits.min_score_share * ranked[0].gain]
    leading = leading[: limits.max_leading]
    uncertain = [
        score
        for score in list(best.values())[len(leading) :]
        if _has_several_nuisance_parameters(score) and score.gain > limits.nuisance_score_share * ranked[0].gain
    ]
    return leading + uncertain[: limits.max_nuisance_trials]


def _has_several_nuisance_parameters(score: Score) -> bool:
    """Whether a score depends on several nuisance parameters, a place and masses, and may be far too small."""
    return sum(item.nuisance for item in score.candidate.placed_effect.parameters) > 1
