"""Fits during the search: with a model error that shrinks as the model gets better, from several starts.

Fits with different model errors are compared by -2 ln likelihood, the volume of the error included: an effect is worth
what it takes off the error of all runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.search.candidates import Candidate
from balance_cli.diagnosis.search.point_mass import refine_point_mass
from balance_cli.diagnosis.search.score_statistics import (
    Score,
    add_candidates,
    add_scored_candidate,
    extend_model,
    has_nuisance_parameters,
)
from balance_cli.diagnosis.search.search_lines import SearchLines
from balance_cli.estimation.levenberg_marquardt import prior_curvature
from balance_cli.estimation.likelihood import data_chi2
from balance_cli.estimation.maximum_likelihood import penalized_chi2, take_first_steps
from balance_cli.estimation.measurements import Batch
from balance_cli.estimation.model_error import (
    ModelErrors,
    add_model_error,
    estimate_model_error,
    log_determinant_inflation,
)
from balance_cli.estimation.starting_values import REGRESSION_PRIOR_SCALES, start_from_equations_of_motion
from balance_cli.model.balance import BalanceModel

Array = NDArray[np.float64]

PENALTY = 6.0
"""What a parameter costs, in -2 ln likelihood."""
# Steps that tell one start from another, and those of a fit.
FIRST_STEPS = 3
STEPS = 12
ROUNDS = 8
# A step that promises less chi-square is the last.
MIN_STEP_GAIN = 4.0
# A model error that shrinks by less than this share in a round has settled.
MIN_ERROR_DECREASE = 0.1


@dataclass(frozen=True)
class SearchState:
    """A model during the search: its parameters, the model error by run, -2 ln likelihood of fitted and judging lines.

    `error`: rms of the model error over the runs.
    """

    model: BalanceModel
    theta: Array
    shares: ModelErrors
    fitted: float
    folds: float

    @property
    def geometry(self) -> Geometry:
        """The geometry with the effects found so far."""
        return self.model.geometry

    @property
    def error(self) -> float:
        """Rms over the runs of the model error, a share of the response."""
        return float(np.sqrt(np.mean(np.square(list(self.shares.values())))))


def fit_until_stable(
    model: BalanceModel, theta: Array, lines: SearchLines, near: ModelErrors | None = None
) -> SearchState:
    """Fit and model error in turn, until the error no longer shrinks."""
    shares = estimate_model_error(lines.fitted, model.system(theta), near)
    for _ in range(ROUNDS):
        theta = take_steps(model, theta, add_model_error(lines.fitted, shares), STEPS)
        before, shares = shares, estimate_model_error(lines.fitted, model.system(theta), shares)
        if all(shares[run] >= (1.0 - MIN_ERROR_DECREASE) * before[run] for run in shares):
            break
    prior = prior_curvature(model.parameters, theta).chi2
    other = estimate_model_error(lines.folds, model.system(theta), shares)
    fitted, folds = (
        minus_two_log_likelihood(model, theta, *pair) + prior for pair in ((lines.fitted, shares), (lines.folds, other))
    )
    return SearchState(model, theta, shares, fitted, folds)


def take_steps(model: BalanceModel, theta: Array, batches: Sequence[Batch], count: int) -> Array:
    """At most `count` steps of the maximum likelihood from `theta`; what the data hardly tell stays near it."""
    return take_first_steps(model, theta, batches, count, REGRESSION_PRIOR_SCALES, MIN_STEP_GAIN).theta


def minus_two_log_likelihood(model: BalanceModel, theta: Array, batches: Sequence[Batch], shares: ModelErrors) -> float:
    """-2 ln likelihood (up to a constant of the data) of these lines, with this model error."""
    return data_chi2(add_model_error(batches, shares), model.system(theta)) + log_determinant_inflation(batches, shares)


@dataclass(frozen=True)
class PartialFit:
    """A few steps of a candidate's fit, with the model error as it was, and where they led.

    `gain`: -2 ln likelihood that is gained if the model error shrinks with chi-square, n ln(chi2 / chi2).
    """

    model: BalanceModel
    theta: Array
    gain: float


def fit_partially(state: SearchState, score: Score, lines: SearchLines) -> PartialFit:
    """The model with the candidate, some steps from where it begins or, if that leads further, from a regression.

    The equations of motion with the cells' forces have no resonances to get wrong (`estimation.starting_values`). They
    are asked where the candidate has values that nobody knows.
    """
    model, theta = extend_model(state.model, state.theta, add_scored_candidate(state.geometry, score))
    if score.candidate.chosen:
        _, null = extend_model(
            state.model, state.theta, add_candidates(state.geometry, [(score.candidate, score.start)])
        )
        theta = refine_point_mass(model, null, add_model_error(lines.fitted, state.shares))
    starts = [theta]
    if has_nuisance_parameters(score):
        starts.append(start_from_equations_of_motion(model.parameters, lines.fitted, model.system, theta))
    return _best_partial_fit(model, starts, state, lines)


def _best_partial_fit(
    model: BalanceModel, starts: Sequence[Array], state: SearchState, lines: SearchLines
) -> PartialFit:
    batches = add_model_error(lines.fitted, state.shares)
    before = penalized_chi2(state.model, state.theta, batches)
    ends = [take_steps(model, start, batches, FIRST_STEPS) for start in starts]
    best = take_steps(model, min(ends, key=lambda end: penalized_chi2(model, end, batches)), batches, FIRST_STEPS)
    chi2 = penalized_chi2(model, best, batches)
    return PartialFit(model, best, data_count(batches) * float(np.log(before / chi2)))


def data_count(batches: Sequence[Batch]) -> float:
    """Real data that the lines hold."""
    return float(sum(np.sum(batch.count) for batch in batches))


def fit_with_candidate(state: SearchState, candidate: Candidate, lines: SearchLines) -> SearchState:
    """The model with the candidate, fitted from its first start."""
    geometry = add_candidates(state.geometry, [(candidate, 0)], at_start_values=True)
    return fit_until_stable(*extend_model(state.model, state.theta, geometry), lines, state.shares)


def restart(state: SearchState, lines: SearchLines) -> SearchState:
    """The same model, everything fitted once more from the regression."""
    theta = start_from_equations_of_motion(state.model.parameters, lines.fitted, state.model.system, state.theta)
    return fit_until_stable(state.model, theta, lines)
