"""Confirmation on all lines, against the noise alone: add the candidates that are still significant.

A candidate must be significant among all that were scored (Bonferroni), must gain on blocks of lines that its step has
not used, and must keep its gain when everything is refitted.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace

from balance_cli.diagnosis.result import Trial
from balance_cli.diagnosis.search.candidates import candidates
from balance_cli.diagnosis.search.preference import choose_most_linear
from balance_cli.diagnosis.search.score_statistics import Score, score_in_two_stages
from balance_cli.diagnosis.search.trials import make_trial
from balance_cli.diagnosis.selection.candidate_refits import first_steps_of_uncertain, refit_with_candidate
from balance_cli.diagnosis.selection.cross_validation import cross_validation_gain
from balance_cli.diagnosis.selection.effect_statistics import confounding_limit
from balance_cli.diagnosis.selection.fit import Fit, unexplained_chi2
from balance_cli.diagnosis.selection.mains_frequency import frequency_looks, independent_gain
from balance_cli.diagnosis.selection.selection_task import SelectionTask
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.diagnosis.significance import bonferroni_p_value
from balance_cli.estimation.batch import Batch
from balance_cli.model.placed_effects import declared_effects

REASON_SMALL_GAIN = "takes too little off what no noise explains"
REASON_NO_TIME = "the time limit was reached before its refit"
REASON_CONFOUNDED = "gains no more than what is not exactly known of "


@dataclass(frozen=True)
class ConfirmedFit:
    """The fit with the effects that were added, and the scores at its end.

    `alternatives`: by label of each added effect, how much larger chi-square is with each other candidate of its round.
    `smallest_p_value`: of the candidates that the confounding limit does not exclude, at the end. `scored`: labels of
    the effects of the model that was scored; `refused`: labels of candidates that were refitted in vain.
    """

    fit: Fit
    trials: tuple[Trial, ...] = ()
    scores: tuple[Score, ...] = ()
    alternatives: dict[str, dict[str, float]] = field(default_factory=dict)
    smallest_p_value: float = 1.0
    scored: frozenset[str] = frozenset()
    refused: frozenset[str] = frozenset()


@dataclass(frozen=True)
class _RoundContext:
    """One round: the fit before it, the scores of all candidates, and the gain that an effect must have.

    `is_last`: there is no time to refit any candidate.
    """

    number: int
    fit: Fit
    batches: Sequence[Batch]
    scores: tuple[Score, ...]
    threshold: float
    settings: SearchSettings
    is_last: bool = False

    def reject(self, scores: Sequence[Score], reason: str) -> tuple[Trial, ...]:
        """Trials of candidates that are rejected without a refit."""
        count, gain = len(self.scores), float("nan")
        return tuple(make_trial(self.number, score, count, gain, False, reason) for score in scores)


@dataclass(frozen=True)
class _RoundResult:
    """The outcome of a round: the new fit (None where nothing was added), and whether the rounds have ended.

    `refused`: labels that were refitted in vain.
    """

    fit: Fit | None
    trials: tuple[Trial, ...]
    alternatives: dict[str, dict[str, float]] = field(default_factory=dict)
    refused: frozenset[str] = frozenset()
    ended: bool = False


def confirm(fit: Fit, task: SelectionTask, first_round: int) -> ConfirmedFit:
    """Add significant effects one by one, as long as each explains a fair share of the unexplained chi-square."""
    result, batches, settings = ConfirmedFit(fit), task.batches, task.settings
    for number in range(first_round, first_round + settings.selection.max_rounds):
        over = task.announce(f"all lines, round {number}")
        fit = result.fit
        pool = candidates(fit.geometry, excluded=settings.excluded)
        scores = score_in_two_stages(fit, batches, pool, settings)
        unexplained = unexplained_chi2(fit, batches, task.error_runs, settings.fit)
        threshold = settings.selection.min_effect_share * unexplained
        smallest_p_value, step = _confirm_round(
            _RoundContext(number, fit, batches, scores, threshold, settings, over), result.refused
        )
        trials, alternatives = (*result.trials, *step.trials), {**result.alternatives, **step.alternatives}
        refused = result.refused | step.refused
        result = ConfirmedFit(step.fit or fit, trials, scores, alternatives, smallest_p_value, _labels(fit), refused)
        if step.ended:
            break
    return result


def score_again(
    confirmation: ConfirmedFit, fit: Fit, batches: Sequence[Batch], settings: SearchSettings
) -> ConfirmedFit:
    """The confirmation with the scores of another fit, where effects were added, dropped or replaced since.

    What a candidate gains beside effects that are gone says nothing about the model that is left.
    """
    if _labels(fit) == confirmation.scored:
        return confirmation
    pool = candidates(fit.geometry, excluded=settings.excluded)
    scores = score_in_two_stages(fit, batches, pool, settings)
    limit, _ = confounding_limit(fit, batches)
    clear = [score for score in scores if score.gain > limit and score.candidate.label not in confirmation.refused]
    return replace(
        confirmation, scores=scores, smallest_p_value=_smallest_p_value(clear, len(scores)), scored=_labels(fit)
    )


def _labels(fit: Fit) -> frozenset[str]:
    """The labels of the effects of a fit."""
    return frozenset(effect.label for effect in declared_effects(fit.geometry))


def _smallest_p_value(scores: Sequence[Score], count: int) -> float:
    """The smallest p-value of these scores, which are some of `count`; one where there are none."""
    return min((bonferroni_p_value(item.gain, item.parameters, count, item.noise_dof) for item in scores), default=1.0)


def _confirm_round(context: _RoundContext, refused: Collection[str]) -> tuple[float, _RoundResult]:
    """The smallest p-value of the candidates that are not confounded, and the outcome of the round."""
    count = len(context.scores)
    limit, cause = confounding_limit(context.fit, context.batches)
    possible = [score for score in context.scores if score.candidate.label not in refused]
    clear = [score for score in possible if score.gain > limit]
    smallest_p_value = _smallest_p_value(clear, count)
    selected = select_significant(clear, count, context.settings)
    if not selected:
        confounded = select_significant([score for score in possible if score.gain <= limit], count, context.settings)
        result = _RoundResult(None, context.reject(confounded, REASON_CONFOUNDED + cause), ended=True)
    elif context.is_last:
        result = _RoundResult(None, context.reject(selected, REASON_NO_TIME), ended=True)
    elif max(score.gain for score in selected) < context.threshold:
        result = _RoundResult(None, context.reject(selected, REASON_SMALL_GAIN), ended=True)
    else:
        result = _refit_selected(context, clear, selected)
    return smallest_p_value, result


def _refit_selected(context: _RoundContext, clear: Sequence[Score], selected: Sequence[Score]) -> _RoundResult:
    """Refit the selected candidates, and accept or refuse the best one."""
    fit, batches, settings, count = context.fit, context.batches, context.settings, len(context.scores)
    started = first_steps_of_uncertain(fit, clear, selected, batches, settings)
    tested = [*selected, *(score for score in clear if score.candidate.label in started)]
    refits = [
        refit_with_candidate(fit, score, batches, started.get(score.candidate.label), settings) for score in tested
    ]
    best = _best_refit(fit, tested, refits, settings)
    validation = cross_validation_gain(fit, batches, tested[best], settings)
    rejection = _rejection_reason(context, tested[best], refits[best], validation)
    trials = []
    for i, (score, refit) in enumerate(zip(tested, refits, strict=True)):
        gain, reason = fit.chi2 - refit.chi2, rejection if i == best else "another gained more"
        cross_validation = validation if i == best else float("nan")
        trials.append(make_trial(context.number, score, count, gain, not reason, reason, cross_validation))
    if rejection:
        refused = frozenset(score.candidate.label for score in tested)
        return _RoundResult(None, tuple(trials), refused=refused, ended=rejection == REASON_SMALL_GAIN)
    gaps = {score.candidate.label: refit.chi2 - refits[best].chi2 for score, refit in zip(tested, refits, strict=True)}
    label = tested[best].candidate.label
    alternatives = {name: gap for name, gap in gaps.items() if name != label}
    return _RoundResult(refits[best], tuple(trials), {label: alternatives})


def _best_refit(fit: Fit, scores: Sequence[Score], refits: Sequence[Fit], settings: SearchSettings) -> int:
    """Index of the refit with the largest gain, less the cost of its parameters."""
    gains = [
        fit.chi2 - refit.chi2 - settings.parameter_cost * score.parameters
        for score, refit in zip(scores, refits, strict=True)
    ]
    terms = [refit.system(derivatives=False).equations.nonlinear_terms for refit in refits]
    return choose_most_linear(terms, gains, settings.indistinguishable_chi2)


def _rejection_reason(context: _RoundContext, score: Score, refit: Fit, validation: float) -> str:
    """Why the best candidate is not accepted; empty where it is."""
    effect, gain = score.candidate.placed_effect, context.fit.chi2 - refit.chi2
    independent = independent_gain(gain, refit, effect, context.batches)
    looks = frequency_looks(context.fit, effect, context.batches, context.settings)
    p_value = bonferroni_p_value(independent, score.parameters, looks * len(context.scores), score.noise_dof)
    if p_value >= context.settings.selection.significance_level:
        return "chance would gain as much"
    # NaN, where all information is in one fold, is no reason to reject.
    if validation <= 0:
        return "gains nothing on lines that its step had not seen"
    return REASON_SMALL_GAIN if gain < context.threshold else ""


def select_significant(scores: Sequence[Score], count: int, settings: SearchSettings) -> list[Score]:
    """Return the candidates of `count` whose gain, less the cost of their parameters, is about that of the best one.

    The best one is that of the largest gain among the significant ones: a larger one may rest on a noise of which
    little is known. None where none is significant.
    """
    limits = settings.selection

    def net_gain(score: Score) -> float:
        return score.gain - settings.parameter_cost * score.parameters

    def is_significant(score: Score) -> bool:
        return bonferroni_p_value(score.gain, score.parameters, count, score.noise_dof) < limits.significance_level

    largest = max((net_gain(score) for score in scores if is_significant(score)), default=None)
    if largest is None:
        return []
    lowest = largest - limits.refit_score_deficit - limits.score_inaccuracy * largest
    close = [score for score in scores if lowest < net_gain(score) <= largest]
    return sorted(close, key=lambda score: -net_gain(score))[: limits.max_refits]
