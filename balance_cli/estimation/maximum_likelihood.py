"""Maximum likelihood of a balance model: output error with noise on channels and loads, and Gaussian priors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch
from balance_cli.estimation.deadline import Deadline
from balance_cli.estimation.levenberg_marquardt import Minimum, minimize, prior_curvature
from balance_cli.estimation.likelihood import Curvature, data_chi2, data_curvature
from balance_cli.estimation.mode_crossings import cross_modes
from balance_cli.estimation.starting_values import add_weak_priors
from balance_cli.model.balance import BalanceModel, Estimate
from balance_cli.model.parameters import ParameterSet

Array = NDArray[np.float64]


# Iterations of one fit: three times as many as fits along curved valleys took (docs/adr/0013-curved-valleys.md).
ITERATIONS = 60
# Predicted decrease of chi-square at which a fit ends: a hundredth of a sigma.
TOLERANCE = 1e-4
# Iterations after which the fits from several starts are compared; only the best is continued.
TRIAL_ITERATIONS = 12


def fit_maximum_likelihood(
    model: BalanceModel,
    batches: Sequence[Batch],
    start: Array,
    iterations: int = ITERATIONS,
    tolerance: float = TOLERANCE,
    known: Curvature | None = None,
    deadline: Deadline | None = None,
) -> Minimum:
    """Maximize the likelihood of the lines (errors on channels and loads) times the priors, from `start`.

    The fit ends when the predicted decrease of chi-square is less than `tolerance`. `known`: the curvature of the data
    at `start`, where another fit of this model to these lines has ended there. `deadline`: as in `minimize`.
    """
    return _minimize_chi2(
        model, model.parameters, batches, start, known, iterations, tolerance, near_minimum=True, deadline=deadline
    )


def _minimize_chi2(
    model: BalanceModel,
    parameters: ParameterSet,
    batches: Sequence[Batch],
    start: Array,
    known: Curvature | None,
    iterations: int,
    tolerance: float,
    near_minimum: bool,
    deadline: Deadline | None,
) -> Minimum:
    """The least chi-square of the lines and of the priors of `parameters`, beyond modes that meet on the way."""

    def fit(begin: Array, known: Curvature | None = None) -> Minimum:
        return minimize(
            parameters,
            begin,
            lambda theta: data_curvature(batches, model.system(theta)),
            lambda theta: data_chi2(batches, model.system(theta, derivatives=False)),
            iterations=iterations,
            tolerance=tolerance,
            known=known,
            near_minimum=near_minimum,
            deadline=deadline,
        )

    return cross_modes(model, fit(start, known), iterations, fit)


def take_first_steps(
    start: Estimate,
    batches: Sequence[Batch],
    count: int,
    prior_scales: float,
    min_decrease: float,
    known: Curvature | None = None,
    deadline: Deadline | None = None,
) -> Minimum:
    """Take at most `count` steps from `start`, with weak priors of `prior_scales` scales on parameters without one.

    As long as an effect is small, the data have no information on the parameters of its shape, and steps along these
    would delay all others. The fit ends when the predicted decrease of chi-square is less than `min_decrease`. The weak
    priors are no part of `total`. `known` and `deadline`: as in a whole fit.
    """
    model = start.model
    weak = add_weak_priors(model.parameters, start.theta, prior_scales)
    minimum = _minimize_chi2(
        model, weak, batches, start.theta, known, count, min_decrease, near_minimum=False, deadline=deadline
    )
    return replace(minimum, total=minimum.data + prior_curvature(model.parameters, minimum.theta))


def penalized_chi2(estimate: Estimate, batches: Sequence[Batch]) -> float:
    """Chi-square of data and priors; infinite where the parameters are not physical."""
    try:
        of_priors = prior_curvature(estimate.model.parameters, estimate.theta).chi2
        return data_chi2(batches, estimate.system(derivatives=False)) + of_priors
    except np.linalg.LinAlgError:
        return float("inf")


def fit_best_start(model: BalanceModel, batches: Sequence[Batch], starts: Mapping[str, Array]) -> tuple[Minimum, str]:
    """The best maximum reached from any of the starts, and the name of that start.

    Chi-square at the start itself is no criterion: a start that is farther off may lead to the better end.
    Raises LinAlgError where no start is physical.
    """
    trials = {name: _try_start(model, batches, start) for name, start in starts.items()}
    minima = {name: trial for name, trial in trials.items() if trial is not None}
    if not minima:
        raise np.linalg.LinAlgError("no start has physical parameters")
    best = min(minima, key=lambda name: minima[name].total.chi2)
    first = minima[best]
    if first.converged:
        return first, best
    rest = fit_maximum_likelihood(model, batches, first.theta, ITERATIONS - TRIAL_ITERATIONS, known=first.data)
    return replace(rest, iterations=first.iterations + rest.iterations), best


def _try_start(model: BalanceModel, batches: Sequence[Batch], start: Array) -> Minimum | None:
    try:
        return fit_maximum_likelihood(model, batches, start, TRIAL_ITERATIONS)
    except np.linalg.LinAlgError:
        return None
