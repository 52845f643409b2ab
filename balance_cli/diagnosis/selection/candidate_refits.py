"""Refits of candidates on all lines, from the starts that their scores suggest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from balance_cli.diagnosis.search.extended_models import add_candidates, extend_model
from balance_cli.diagnosis.search.point_mass import refine_point_mass
from balance_cli.diagnosis.search.refit import regress
from balance_cli.diagnosis.search.score_statistics import Score, apply_score_step, has_nuisance_parameters
from balance_cli.diagnosis.selection.fit import Fit, continue_fit, fit_all_lines, start_fit
from balance_cli.diagnosis.selection.mains_frequency import refit_at_best_frequency
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.maximum_likelihood import penalized_chi2
from balance_cli.model.balance import Estimate


def first_steps_of_uncertain(
    fit: Fit,
    candidates: Sequence[Score],
    selected: Sequence[Score],
    batches: Sequence[Batch],
    settings: SearchSettings,
) -> dict[str, Fit]:
    """Return further candidates whose first steps gain as much as the selected ones, by label, with these steps.

    They have nuisance parameters, at whose start values their scores may be far too small.
    """
    limits = settings.selection
    threshold, labels = min(score.gain for score in selected), {score.candidate.label for score in selected}
    uncertain = [
        score
        for score in candidates
        if score.candidate.label not in labels
        and has_nuisance_parameters(score)
        and score.gain > limits.nuisance_score_share * selected[0].gain
        and score.p_value < limits.significance_level
    ]
    result = {}
    for score in sorted(uncertain, key=lambda score: -score.gain)[: limits.max_nuisance_refits]:
        first = fit_first_steps(fit, score, batches, settings)
        if fit.chi2 - first.chi2 - settings.parameter_cost * score.parameters > threshold:
            result[score.candidate.label] = first
    return result


def fit_first_steps(fit: Fit, score: Score, batches: Sequence[Batch], settings: SearchSettings) -> Fit:
    """Return the first steps with a candidate, from its score's step or from a regression, whichever fits better.

    A point mass starts at its best place.
    """
    if score.candidate.fitted_start_values:
        return start_fit(start_point_mass(fit, score, batches, settings), batches, settings.fit)
    near = apply_score_step(fit, batches, score, settings.score)
    regressed = regress(near, batches, settings.fit)
    is_finite = np.isfinite(penalized_chi2(regressed, batches))
    starts = [near, regressed] if is_finite else [near]
    return min((start_fit(start, batches, settings.fit) for start in starts), key=lambda end: end.chi2)


def start_scored_candidate(fit: Fit, score: Score, batches: Sequence[Batch], settings: SearchSettings) -> Estimate:
    """Return the model with a candidate at its score's step, or at the best place of a mass."""
    if score.candidate.fitted_start_values:
        return start_point_mass(fit, score, batches, settings)
    return apply_score_step(fit, batches, score, settings.score)


def fit_scored_candidate(fit: Fit, score: Score, batches: Sequence[Batch], settings: SearchSettings) -> Fit:
    """Return the refit with a candidate from its score's step, or, of a point mass, from its best place."""
    return fit_all_lines(start_scored_candidate(fit, score, batches, settings), batches, settings.fit)


def start_point_mass(fit: Fit, score: Score, batches: Sequence[Batch], settings: SearchSettings) -> Estimate:
    """Return the model with a point mass at its best place."""
    geometry = add_candidates(fit.geometry, [(score.candidate, score.start)])
    return refine_point_mass(extend_model(fit, geometry), batches, settings)


def refit_with_candidate(
    fit: Fit, score: Score, batches: Sequence[Batch], first: Fit | None, settings: SearchSettings
) -> Fit:
    """Return the refit with a candidate, from its `first` steps; with a large score from its start values, too.

    Where neither converges, in a curved valley of chi-square, it is fitted with its nuisance parameters held at first.
    """
    if not has_nuisance_parameters(score):
        return fit_scored_candidate(fit, score, batches, settings)
    first = fit_first_steps(fit, score, batches, settings) if first is None else first
    best = continue_fit(first, batches, settings.fit)
    if score.gain >= settings.selection.strong_gain and not score.candidate.fitted_start_values:
        geometry = add_candidates(fit.geometry, [(score.candidate, score.start)], at_start_values=True)
        from_start = fit_all_lines(extend_model(fit, geometry), batches, settings.fit)
        best = min(best, from_start, key=lambda end: end.chi2)
        if not best.minimum.converged:
            best = min(best, _fit_nuisance_last(fit, score, batches, settings), key=lambda end: end.chi2)
    return refit_at_best_frequency(best, [score.candidate.placed_effect], batches, settings)


def _fit_nuisance_last(fit: Fit, score: Score, batches: Sequence[Batch], settings: SearchSettings) -> Fit:
    """The refit with the nuisance parameters of a candidate held until all others are fitted."""
    near = apply_score_step(fit, batches, score, settings.score)
    model = near.model
    effect, names = score.candidate.placed_effect, model.parameters.names
    nuisance = {effect.full_name(item) for item in effect.parameters if item.nuisance}
    sigma = [0.0 if name in nuisance else s for name, s in zip(names, model.parameters.sigma, strict=True)]
    held = fit_all_lines(model.with_sigma(np.array(sigma)).at(near.theta), batches, settings.fit)
    return fit_all_lines(model.at(held.theta), batches, settings.fit)
