"""Maximum likelihood of a balance model: output error with noise on channels and loads, and Gaussian priors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch
from balance_cli.estimation.levenberg_marquardt import Minimum, minimize, prior_curvature
from balance_cli.estimation.likelihood import data_chi2, data_curvature
from balance_cli.estimation.starting_values import add_weak_priors
from balance_cli.model.balance import BalanceModel

Array = NDArray[np.float64]


ITERATIONS = 60
TOLERANCE = 1e-4
# After so many the starts of a fit are compared, and the best goes on alone.
TRIAL_ITERATIONS = 12


def fit_maximum_likelihood(
    model: BalanceModel,
    batches: Sequence[Batch],
    start: Array,
    iterations: int = ITERATIONS,
    tolerance: float = TOLERANCE,
) -> Minimum:
    """Maximise the likelihood of the lines (errors on channels and loads) times the priors, from `start`.

    The last step is one that promises to lower chi-square by less than `tolerance`.
    """
    return minimize(
        model.parameters,
        start,
        lambda theta: data_curvature(batches, model.system(theta)),
        lambda theta: data_chi2(batches, model.system(theta)),
        iterations=iterations,
        tolerance=tolerance,
    )


def take_first_steps(
    model: BalanceModel, theta: Array, batches: Sequence[Batch], count: int, prior_scales: float, min_decrease: float
) -> Minimum:
    """At most `count` steps from `theta`, near which parameters without a prior are held: `within` so many scales.

    Where an effect is small, the data say nothing of what shapes it, and steps along that would hold up all others.
    The last step is one that promises to lower chi-square by less than `min_decrease`; what holds counts in `total`.
    """
    return minimize(
        add_weak_priors(model.parameters, theta, prior_scales),
        theta,
        lambda at: data_curvature(batches, model.system(at)),
        lambda at: data_chi2(batches, model.system(at)),
        iterations=count,
        tolerance=min_decrease,
    )


def penalized_chi2(model: BalanceModel, theta: Array, batches: Sequence[Batch]) -> float:
    """Chi-square of data and priors; infinite where no rig is like that."""
    try:
        return data_chi2(batches, model.system(theta)) + prior_curvature(model.parameters, theta).chi2
    except np.linalg.LinAlgError:
        return float("inf")


def fit_best_start(model: BalanceModel, batches: Sequence[Batch], starts: Mapping[str, Array]) -> tuple[Minimum, str]:
    """The best maximum that is reached from any of the starts, and the name of that start.

    Which start is nearer in chi-square says little: one that is far in many parameters may lead to the better end.
    Raises LinAlgError where no rig is like any of them.
    """
    trials = {name: _try_start(model, batches, start) for name, start in starts.items()}
    found = {name: trial for name, trial in trials.items() if trial is not None}
    if not found:
        raise np.linalg.LinAlgError("no rig is like any of the starts")
    best = min(found, key=lambda name: found[name].total.chi2)
    first = found[best]
    if first.converged:
        return first, best
    rest = fit_maximum_likelihood(model, batches, first.theta, ITERATIONS - TRIAL_ITERATIONS)
    return replace(rest, iterations=first.iterations + rest.iterations), best


def _try_start(model: BalanceModel, batches: Sequence[Batch], start: Array) -> Minimum | None:
    try:
        return fit_maximum_likelihood(model, batches, start, TRIAL_ITERATIONS)
    except np.linalg.LinAlgError:
        return None
