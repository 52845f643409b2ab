"""Fits during the search, with a model error that shrinks as the model improves, from several starts.

Fits with different model errors are compared by -2 ln likelihood, including the log-determinant of the error, so that
an effect gains by reducing the error of all runs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from balance_cli.diagnosis.fit_settings import FitSettings
from balance_cli.diagnosis.search.candidates import Candidate
from balance_cli.diagnosis.search.extended_models import add_candidates, extend_model
from balance_cli.diagnosis.search.point_mass import refine_point_mass
from balance_cli.diagnosis.search.score_statistics import Score, add_scored_candidate, has_nuisance_parameters
from balance_cli.diagnosis.search.search_lines import SearchLines
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.levenberg_marquardt import Minimum, prior_curvature
from balance_cli.estimation.likelihood import Curvature, count_measured_values, data_chi2
from balance_cli.estimation.maximum_likelihood import penalized_chi2, take_first_steps
from balance_cli.estimation.mode_crossings import exchanged_modes
from balance_cli.estimation.model_error import (
    ModelErrors,
    add_model_error,
    estimate_model_error,
    log_determinant_inflation,
)
from balance_cli.estimation.starting_values import (
    REGRESSION_PRIOR_SCALES,
    find_starting_values,
    start_from_equations_of_motion,
)
from balance_cli.model.balance import Estimate
from balance_cli.model.system import System


@dataclass(frozen=True)
class SearchState(Estimate):
    """The estimate at a stage of the search, and the model error of each run as a share.

    `fit_criterion` and `validation_criterion`: -2 ln likelihood of the fitted and of the validation lines.
    """

    shares: ModelErrors
    fit_criterion: float
    validation_criterion: float

    @property
    def error(self) -> float:
        """Rms of the model error over the runs, a share of the response."""
        return float(np.sqrt(np.mean(np.square(list(self.shares.values())))))


def fit_until_stable(
    estimate: Estimate, lines: SearchLines, settings: FitSettings, shares: ModelErrors | None = None
) -> SearchState:
    """Return the fit from an estimate after rounds of fit and model error, until the error no longer shrinks.

    `shares`: the model error to start from. Where two modes are close, the fit may have to go on beyond their crossing.
    """
    return _cross_close_modes(_fit_rounds(estimate, lines, settings, shares), lines, settings)


def _cross_close_modes(state: SearchState, lines: SearchLines, settings: FitSettings) -> SearchState:
    """Return the state, or a better one that begins with two close modes exchanged.

    A mass or spring that the model had lacked may exchange the order of two modes (`estimation.mode_crossings`).
    """
    for start in exchanged_modes(state.model, state.theta) if any(state.shares.values()) else ():
        if settings.is_over:
            break
        weighted = add_model_error(lines.fitted, state.shares)
        with suppress(np.linalg.LinAlgError):
            end = take_steps(state.model.at(start), weighted, settings.search_steps, settings)
            if end.total.chi2 < penalized_chi2(state, weighted):
                beyond = _fit_rounds(state.model.at(end.theta), lines, settings, state.shares)
                state = min(state, beyond, key=lambda item: item.fit_criterion)
    return state


def _fit_rounds(
    estimate: Estimate, lines: SearchLines, settings: FitSettings, shares: ModelErrors | None
) -> SearchState:
    shares = estimate_model_error(lines.fitted, estimate.system(derivatives=False), shares)
    for _ in range(settings.search_rounds):
        weighted = add_model_error(lines.fitted, shares)
        estimate = estimate.model.at(take_steps(estimate, weighted, settings.search_steps, settings).theta)
        system = estimate.system(derivatives=False)
        before, shares = shares, estimate_model_error(lines.fitted, system, shares)
        if settings.is_over or all(shares[run] >= (1.0 - settings.min_error_decrease) * before[run] for run in shares):
            break
    prior = prior_curvature(estimate.model.parameters, estimate.theta).chi2
    validation_shares = estimate_model_error(lines.validation, system, shares)
    fit_criterion = minus_two_log_likelihood(system, lines.fitted, shares) + prior
    validation_criterion = minus_two_log_likelihood(system, lines.validation, validation_shares) + prior
    return SearchState(estimate.model, estimate.theta, shares, fit_criterion, validation_criterion)


def take_steps(
    start: Estimate, batches: Sequence[Batch], count: int, settings: FitSettings, known: Curvature | None = None
) -> Minimum:
    """Return the end of at most `count` steps of maximum likelihood; poorly informed parameters stay near the start.

    `known`: the curvature of the data at the start, where other steps have ended there.
    """
    min_gain, deadline = settings.search_min_step_gain, settings.deadline
    return take_first_steps(start, batches, count, REGRESSION_PRIOR_SCALES, min_gain, known, deadline)


def minus_two_log_likelihood(system: System, batches: Sequence[Batch], shares: ModelErrors) -> float:
    """Return -2 ln likelihood of these lines with this model error, up to a constant of the data."""
    return data_chi2(add_model_error(batches, shares), system) + log_determinant_inflation(batches, shares)


@dataclass(frozen=True)
class PartialFit(Estimate):
    """The first steps of a candidate's fit, with the model error of the state before it.

    `gain`: decrease of -2 ln likelihood if the model error shrinks with chi-square, n ln(chi2 before / chi2 after).
    """

    gain: float


def fit_partially(state: SearchState, score: Score, lines: SearchLines, settings: SearchSettings) -> PartialFit:
    """Return the first steps with the candidate, from its start or, if that fits better, from a regression.

    The equations of motion with the forces of the cells have no resonance that could lead to a wrong minimum
    (`estimation.starting_values`). They are solved where the candidate has nuisance parameters.
    """
    batches = add_model_error(lines.fitted, state.shares)
    start = extend_model(state, add_scored_candidate(state.geometry, score))
    if score.candidate.fitted_start_values:
        null = extend_model(state, add_candidates(state.geometry, [(score.candidate, score.start)]))
        start = refine_point_mass(start.model.at(null.theta), batches, settings)
    starts = [start]
    if has_nuisance_parameters(score):
        starts.append(regress(start, lines.fitted, settings.fit))
    return _best_partial_fit(starts, state, batches, settings.fit)


def _best_partial_fit(
    starts: Sequence[Estimate], state: SearchState, batches: Sequence[Batch], settings: FitSettings
) -> PartialFit:
    before, model = penalized_chi2(state, batches), starts[0].model
    ends = [take_steps(start, batches, settings.trial_steps, settings) for start in starts]
    best = min(ends, key=lambda end: end.total.chi2)
    best = take_steps(model.at(best.theta), batches, settings.trial_steps, settings, best.data)
    return PartialFit(model, best.theta, count_measured_values(batches) * float(np.log(before / best.total.chi2)))


def regress(start: Estimate, batches: Sequence[Batch], settings: FitSettings) -> Estimate:
    """Return the same model at the regression on the equations of motion, begun at the values of `start`."""
    model = start.model
    return model.at(
        start_from_equations_of_motion(model.parameters, batches, model.system, start.theta, settings.deadline)
    )


def regress_in_bands(start: Estimate, batches: Sequence[Batch], settings: FitSettings) -> Estimate:
    """Return what `regress` returns, begun with the lowest lines, where a further body is only a deflection.

    In wider bands its resonance lies between the start and the truth where it is low, as that of a heavy body is.
    """
    model = start.model
    try:
        with np.errstate(all="ignore"):
            points = find_starting_values(model.parameters, batches, model.system, start.theta, settings.deadline)
    except np.linalg.LinAlgError:
        return start
    return model.at(points.effects_free) if np.all(np.isfinite(points.effects_free)) else start


def fit_with_candidate(
    state: SearchState, candidate: Candidate, lines: SearchLines, settings: FitSettings
) -> SearchState:
    """Return the model with the candidate, fitted from its first start."""
    geometry = add_candidates(state.geometry, [(candidate, 0)], at_start_values=True)
    return fit_until_stable(extend_model(state, geometry), lines, settings, state.shares)


def restart(state: SearchState, lines: SearchLines, settings: FitSettings) -> SearchState:
    """Return the same model, with all parameters fitted again from the regression."""
    return fit_until_stable(regress(state, lines.fitted, settings), lines, settings)


def whole_fit(
    state: SearchState,
    added: Sequence[Candidate],
    lines: SearchLines,
    settings: SearchSettings,
    regression: Callable[[Estimate, Sequence[Batch], FitSettings], Estimate] = regress,
) -> SearchState:
    """Return the fit from a regression that begins at the declared values: those of the state fit without the added.

    The candidates begin at their first start.
    """
    geometry = add_candidates(state.geometry, [(item, 0) for item in added], at_start_values=True)
    model = extend_model(state, geometry).model
    declared = model.at()
    return fit_until_stable(regression(declared, lines.fitted, settings.fit), lines, settings.fit)
