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
from balance_cli.diagnosis.search.point_mass import settled_mass
from balance_cli.diagnosis.search.score_statistics import Score, extended, has_shape, with_begun, with_candidates
from balance_cli.diagnosis.search.search_lines import SearchLines
from balance_cli.estimation.levenberg_marquardt import prior_curvature
from balance_cli.estimation.likelihood import data_chi2
from balance_cli.estimation.maximum_likelihood import first_steps, penalised_chi2
from balance_cli.estimation.measurements import Batch
from balance_cli.estimation.model_error import (
    Shares,
    log_volume,
    shares_that_explain,
    with_model_error,
)
from balance_cli.estimation.starting_values import NEAR, by_equations_of_motion
from balance_cli.model.balance import BalanceModel

Array = NDArray[np.float64]

PENALTY = 6.0
"""What a parameter costs, in -2 ln likelihood."""
# Steps that tell one start from another, and those of a fit.
FIRST_STEPS = 3
STEPS = 12
ROUNDS = 8
# A step that promises less chi-square is the last.
PROMISED = 4.0
# A model error that shrinks by less than this share in a round has settled.
SETTLED = 0.1


@dataclass(frozen=True)
class State:
    """A model during the search: its parameters, the model error by run, -2 ln likelihood of fitted and judging lines.

    `error`: rms of the model error over the runs.
    """

    model: BalanceModel
    theta: Array
    shares: Shares
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


def settled(model: BalanceModel, theta: Array, lines: SearchLines, near: Shares | None = None) -> State:
    """Fit and model error in turn, until the error no longer shrinks."""
    shares = shares_that_explain(lines.fitted, model.system(theta), near)
    for _ in range(ROUNDS):
        theta = steps(model, theta, with_model_error(lines.fitted, shares), STEPS)
        before, shares = shares, shares_that_explain(lines.fitted, model.system(theta), shares)
        if all(shares[run] >= (1.0 - SETTLED) * before[run] for run in shares):
            break
    prior = prior_curvature(model.parameters, theta).chi2
    other = shares_that_explain(lines.folds, model.system(theta), shares)
    fitted, folds = (criterion(model, theta, *pair) + prior for pair in ((lines.fitted, shares), (lines.folds, other)))
    return State(model, theta, shares, fitted, folds)


def steps(model: BalanceModel, theta: Array, batches: Sequence[Batch], count: int) -> Array:
    """At most `count` steps of the maximum likelihood from `theta`; what the data hardly tell stays near it."""
    return first_steps(model, theta, batches, count, NEAR, PROMISED).theta


def criterion(model: BalanceModel, theta: Array, batches: Sequence[Batch], shares: Shares) -> float:
    """-2 ln likelihood (up to a constant of the data) of these lines, with this model error."""
    return data_chi2(with_model_error(batches, shares), model.system(theta)) + log_volume(batches, shares)


@dataclass(frozen=True)
class Attempt:
    """A few steps of a candidate's fit, with the model error as it was, and where they led.

    `gain`: -2 ln likelihood that is gained if the model error shrinks with chi-square, n ln(chi2 / chi2).
    """

    model: BalanceModel
    theta: Array
    gain: float


def attempt(state: State, score: Score, lines: SearchLines) -> Attempt:
    """The model with the candidate, some steps from where it begins or, if that leads further, from a regression.

    The equations of motion with the cells' forces have no resonances to get wrong (`estimation.starting_values`). They
    are asked where the candidate has values that nobody knows.
    """
    model, theta = extended(state.model, state.theta, with_begun(state.geometry, score))
    if score.candidate.chosen:
        _, null = extended(state.model, state.theta, with_candidates(state.geometry, [(score.candidate, score.start)]))
        theta = settled_mass(model, null, with_model_error(lines.fitted, state.shares))
    starts = [theta]
    if has_shape(score):
        starts.append(by_equations_of_motion(model.parameters, lines.fitted, model.system, theta))
    return _further(model, starts, state, lines)


def _further(model: BalanceModel, starts: Sequence[Array], state: State, lines: SearchLines) -> Attempt:
    batches = with_model_error(lines.fitted, state.shares)
    before = penalised_chi2(state.model, state.theta, batches)
    ends = [steps(model, start, batches, FIRST_STEPS) for start in starts]
    best = steps(model, min(ends, key=lambda end: penalised_chi2(model, end, batches)), batches, FIRST_STEPS)
    chi2 = penalised_chi2(model, best, batches)
    return Attempt(model, best, data_count(batches) * float(np.log(before / chi2)))


def data_count(batches: Sequence[Batch]) -> float:
    """Real data that the lines hold."""
    return float(sum(np.sum(batch.count) for batch in batches))


def with_candidate(state: State, candidate: Candidate, lines: SearchLines) -> State:
    """The model with the candidate, fitted from its first start."""
    geometry = with_candidates(state.geometry, [(candidate, 0)], started=True)
    return settled(*extended(state.model, state.theta, geometry), lines, state.shares)


def begun_anew(state: State, lines: SearchLines) -> State:
    """The same model, everything fitted once more from the regression."""
    theta = by_equations_of_motion(state.model.parameters, lines.fitted, state.model.system, state.theta)
    return settled(state.model, theta, lines)
