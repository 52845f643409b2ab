"""Suspected effects: hypotheses of the user, tested one by one whatever the search has found.

A hypothesis that was made before the data were looked at is one test, so that its p-value is corrected for its own
places only and not for all candidates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from balance_cli.diagnosis.result import Trial
from balance_cli.diagnosis.search.candidates import Candidate, suspected_candidates
from balance_cli.diagnosis.search.score_statistics import Score, score_in_two_stages
from balance_cli.diagnosis.search.trials import make_trial
from balance_cli.diagnosis.selection.alternatives import EffectSupport
from balance_cli.diagnosis.selection.candidate_refits import refit_with_candidate
from balance_cli.diagnosis.selection.cross_validation import cross_validation_gain
from balance_cli.diagnosis.selection.fit import Fit
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.diagnosis.significance import bonferroni_p_value
from balance_cli.estimation.batch import Batch

SUSPECTED = "suspected"
REASON_CHANCE = "suspected, but chance would gain as much"
REASON_VALIDATION = "suspected, but gains nothing on lines that its step had not seen"


@dataclass(frozen=True)
class HypothesisResult:
    """The fit with the suspected effects that are supported, their support, and the trials of those tested."""

    fit: Fit
    support: dict[str, EffectSupport]
    trials: tuple[Trial, ...] = ()


def examine_hypotheses(fit: Fit, batches: Sequence[Batch], number: int, settings: SearchSettings) -> HypothesisResult:
    """Return the fit with those suspected effects that it lacks and that are significant by themselves."""
    result = HypothesisResult(fit, {})
    for word in settings.suspected:
        pool = suspected_candidates(word, result.fit.geometry)
        if pool:
            result = _examine(result, pool, batches, number, settings)
    return result


def _examine(
    result: HypothesisResult, pool: Sequence[Candidate], batches: Sequence[Batch], number: int, settings: SearchSettings
) -> HypothesisResult:
    fit, count = result.fit, len(pool)
    scores = score_in_two_stages(fit, batches, pool, settings)
    best = max(scores, key=lambda score: score.gain - settings.parameter_cost * score.parameters)
    refit = refit_with_candidate(fit, best, batches, None, settings)
    gain = fit.chi2 - refit.chi2
    validation = cross_validation_gain(fit, batches, best, settings)
    p_value = bonferroni_p_value(gain, max(best.parameters, 1), count, best.noise_dof)
    reason = _rejection_reason(p_value, validation, settings)
    trial = make_trial(number, best, count, gain, not reason, reason or SUSPECTED, validation)
    if reason:
        return HypothesisResult(fit, result.support, (*result.trials, trial))
    support = {**result.support, best.candidate.label: _support(gain, best, count)}
    return HypothesisResult(refit, support, (*result.trials, trial))


def _rejection_reason(p_value: float, validation: float, settings: SearchSettings) -> str:
    """Why a suspected effect is not accepted; empty where it is."""
    if p_value >= settings.selection.significance_level:
        return REASON_CHANCE
    # NaN, where all information is in one fold, is no reason to reject.
    return REASON_VALIDATION if validation <= 0 else ""


def _support(gain: float, score: Score, count: int) -> EffectSupport:
    return EffectSupport(gain, score.parameters, (), count)
