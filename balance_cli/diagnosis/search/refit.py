"""Fits during the search, with a model error that shrinks as the model improves, from several starts.

Fits with different model errors are compared by -2 ln likelihood, including the log-determinant of the error, so that
an effect gains by reducing the error of all runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.fit_settings import FitSettings
from balance_cli.diagnosis.search.candidates import Candidate
from balance_cli.diagnosis.search.extended_models import add_candidates, extend_model
from balance_cli.diagnosis.search.point_mass import refine_point_mass
from balance_cli.diagnosis.search.score_statistics import Score, add_scored_candidate, has_nuisance_parameters
from balance_cli.diagnosis.search.search_lines import SearchLines
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.levenberg_marquardt import Minimum, prior_curvature
from balance_cli.estimation.likelihood import Curvature, data_chi2
from balance_cli.estimation.maximum_likelihood import penalized_chi2, take_first_steps
from balance_cli.estimation.model_error import (
    ModelErrors,
    add_model_error,
    estimate_model_error,
    log_determinant_inflation,
)
from balance_cli.estimation.starting_values import REGRESSION_PRIOR_SCALES, start_from_equations_of_motion
from balance_cli.model.balance import BalanceModel
from balance_cli.model.system import System

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SearchState:
    """A model during the search: its parameters `theta` (p,), and the model error of each run as a share.

    `fit_criterion` and `validation_criterion`: -2 ln likelihood of the fitted and of the validation lines.
    """

    model: BalanceModel
    theta: Array
    shares: ModelErrors
    fit_criterion: float
    validation_criterion: float

    @property
    def geometry(self) -> Geometry:
        """The geometry with the effects found so far."""
        return self.model.geometry

    @property
    def error(self) -> float:
        """Rms of the model error over the runs, a share of the response."""
        return float(np.sqrt(np.mean(np.square(list(self.shares.values())))))


def fit_until_stable(
    model: BalanceModel, theta: Array, lines: SearchLines, settings: FitSettings, shares: ModelErrors | None = None
) -> SearchState:
    """Return the fit from `theta` after rounds of fit and model error, until the error no longer shrinks.

    `shares`: the model error to start from.
    """
    shares = estimate_model_error(lines.fitted, model.system(theta, derivatives=False), shares)
    for _ in range(settings.search_rounds):
        weighted = add_model_error(lines.fitted, shares)
        theta = take_steps(model, theta, weighted, settings.search_steps, settings).theta
        system = model.system(theta, derivatives=False)
        before, shares = shares, estimate_model_error(lines.fitted, system, shares)
        if settings.is_over or all(shares[run] >= (1.0 - settings.min_error_decrease) * before[run] for run in shares):
            break
    prior = prior_curvature(model.parameters, theta).chi2
    validation_shares = estimate_model_error(lines.validation, system, shares)
    fit_criterion = minus_two_log_likelihood(system, lines.fitted, shares) + prior
    validation_criterion = minus_two_log_likelihood(system, lines.validation, validation_shares) + prior
    return SearchState(model, theta, shares, fit_criterion, validation_criterion)


def take_steps(
    model: BalanceModel,
    theta: Array,
    batches: Sequence[Batch],
    count: int,
    settings: FitSettings,
    known: Curvature | None = None,
) -> Minimum:
    """Return the end of at most `count` steps of maximum likelihood; poorly informed parameters stay near `theta`.

    `known`: the curvature of the data at `theta`, where other steps have ended there.
    """
    min_gain, deadline = settings.search_min_step_gain, settings.deadline
    return take_first_steps(model, theta, batches, count, REGRESSION_PRIOR_SCALES, min_gain, known, deadline)


def minus_two_log_likelihood(system: System, batches: Sequence[Batch], shares: ModelErrors) -> float:
    """Return -2 ln likelihood of these lines with this model error, up to a constant of the data."""
    return data_chi2(add_model_error(batches, shares), system) + log_determinant_inflation(batches, shares)


@dataclass(frozen=True)
class PartialFit:
    """The first steps of a candidate's fit, with the model error of the state before it.

    `gain`: decrease of -2 ln likelihood if the model error shrinks with chi-square, n ln(chi2 before / chi2 after).
    """

    model: BalanceModel
    theta: Array
    gain: float


def fit_partially(state: SearchState, score: Score, lines: SearchLines, settings: SearchSettings) -> PartialFit:
    """Return the first steps with the candidate, from its start or, if that fits better, from a regression.

    The equations of motion with the forces of the cells have no resonance that could lead to a wrong minimum
    (`estimation.starting_values`). They are solved where the candidate has nuisance parameters.
    """
    batches = add_model_error(lines.fitted, state.shares)
    model, theta = extend_model(state.model, state.theta, add_scored_candidate(state.geometry, score))
    if score.candidate.fitted_start_values:
        geometry = add_candidates(state.geometry, [(score.candidate, score.start)])
        theta = refine_point_mass(model, extend_model(state.model, state.theta, geometry)[1], batches, settings)
    starts = [theta]
    if has_nuisance_parameters(score):
        deadline = settings.fit.deadline
        starts.append(start_from_equations_of_motion(model.parameters, lines.fitted, model.system, theta, deadline))
    return _best_partial_fit(model, starts, state, batches, settings.fit)


def _best_partial_fit(
    model: BalanceModel, starts: Sequence[Array], state: SearchState, batches: Sequence[Batch], settings: FitSettings
) -> PartialFit:
    before = penalized_chi2(state.model, state.theta, batches)
    ends = [take_steps(model, start, batches, settings.trial_steps, settings) for start in starts]
    best = min(ends, key=lambda end: end.total.chi2)
    best = take_steps(model, best.theta, batches, settings.trial_steps, settings, best.data)
    return PartialFit(model, best.theta, data_count(batches) * float(np.log(before / best.total.chi2)))


def data_count(batches: Sequence[Batch]) -> float:
    """Return the number of real values in the lines."""
    return float(sum(np.sum(batch.lines.count) for batch in batches))


def fit_with_candidate(
    state: SearchState, candidate: Candidate, lines: SearchLines, settings: FitSettings
) -> SearchState:
    """Return the model with the candidate, fitted from its first start."""
    geometry = add_candidates(state.geometry, [(candidate, 0)], at_start_values=True)
    return fit_until_stable(*extend_model(state.model, state.theta, geometry), lines, settings, state.shares)


def restart(state: SearchState, lines: SearchLines, settings: FitSettings) -> SearchState:
    """Return the same model, with all parameters fitted again from the regression."""
    model = state.model
    theta = start_from_equations_of_motion(model.parameters, lines.fitted, model.system, state.theta, settings.deadline)
    return fit_until_stable(state.model, theta, lines, settings)
