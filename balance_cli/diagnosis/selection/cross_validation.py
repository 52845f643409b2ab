"""Cross-validation of one step: the gain of a candidate on blocks of lines from which its step was not taken.

Near the null chi-square is a parabola. With the derivative J of all parameters by those of the candidate, the fitted
ones following, gradient g_k and information I_k of fold k give s_k = -J'g_k and V_k = J'I_k J. The step d of the other
folds gains 2 s_k'd - d'V_k d on fold k. The gains of all folds are added. Blocks are used instead of single lines
because neighbors share their errors.

The fitted parameters are not fitted again without each fold. The peak of a mode is narrower than a block, and without
it the error of that mode's frequency would exceed the gain in question.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.search.bounded_gain import best_gain, one_sided_bounds
from balance_cli.diagnosis.search.candidates import parameters_of_interest
from balance_cli.diagnosis.search.extended_models import (
    add_candidates,
    extend_model,
    free_names,
    hold_other_parameters,
)
from balance_cli.diagnosis.search.score_statistics import Score
from balance_cli.diagnosis.settings import CrossValidationSettings, SearchSettings
from balance_cli.estimation.batch import Batch, select_lines
from balance_cli.estimation.identifiability import covariance_from_information
from balance_cli.estimation.levenberg_marquardt import prior_curvature
from balance_cli.estimation.likelihood import Curvature, data_curvature
from balance_cli.model.balance import Estimate

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]


def split_folds(batches: Sequence[Batch], settings: CrossValidationSettings) -> tuple[tuple[Batch, ...], ...]:
    """Return the lines in folds: blocks of each run's lines in turn, single lines where a run has few.

    Every run starts with another fold, so that the means of all runs are not in the same fold.
    """
    runs_before = [sum(len(batch.run_names) for batch in batches[:i]) for i in range(len(batches))]
    folds = [_fold_numbers(batch, first, settings) for batch, first in zip(batches, runs_before, strict=True)]
    return tuple(
        tuple(select_lines(batch, fold == number) for batch, fold in zip(batches, folds, strict=True))
        for number in range(settings.folds)
    )


def _fold_numbers(batch: Batch, first: int, settings: CrossValidationSettings) -> Index:
    fold = np.zeros(len(batch.lines.index), np.intp)
    for run, part in enumerate(batch.parts):
        count = part.stop - part.start
        block = settings.block if count >= 2 * settings.folds * settings.block else 1
        fold[part] = (np.arange(count) // block + first + run) % settings.folds
    return fold


def cross_validation_gain(
    estimate: Estimate, batches: Sequence[Batch], score: Score, settings: SearchSettings
) -> float:
    """Return the gain of a candidate in chi-square on lines from which its step was not taken.

    NaN where nearly all information about it is in one fold.
    """
    effect = score.candidate.placed_effect
    null = extend_model(estimate, add_candidates(estimate.geometry, [(score.candidate, score.start)]))
    items = parameters_of_interest(effect.parameters)
    names = [effect.full_name(item) for item in items]
    extended = hold_other_parameters(null.model, estimate.model, set(names))
    system, prior = extended.system(null.theta), prior_curvature(extended.parameters, null.theta)
    # What is declared with a tolerance is data too: a fold of its own.
    parts = [*(data_curvature(fold, system) for fold in split_folds(batches, settings.cross_validation)), prior]
    free = free_names(extended)
    J = parameter_sensitivity(sum(parts[:-1], prior), np.array([free.index(name) for name in names], np.intp))
    s = np.array([-J.T @ part.gradient for part in parts])
    V = np.array([J.T @ part.information @ J for part in parts])
    return _predicted_gain(s, V, *one_sided_bounds(items), settings)


def parameter_sensitivity(total: Curvature, tested: Index) -> Array:
    """Return J (p, q), the derivative of all parameters by the `tested` ones (q,), the others following."""
    fitted = np.setdiff1d(np.arange(len(total.gradient)), tested)
    covariance = covariance_from_information(total.information[np.ix_(fitted, fitted)])
    J = np.zeros((len(total.gradient), len(tested)))
    J[tested] = np.eye(len(tested))
    J[fitted] = -covariance @ total.information[np.ix_(fitted, tested)]
    return J


def _predicted_gain(s: Array, V: Array, lower: Mask, upper: Mask, settings: SearchSettings) -> float:
    """Sum over the folds, with s (K, q) and V (K, q, q), of each one's gain by the step of the others."""
    limits, total = settings.cross_validation, V.sum(axis=0)
    covariance = covariance_from_information(total)
    share = np.trace(covariance @ V, axis1=1, axis2=2) / max(np.trace(covariance @ total), np.finfo(float).tiny)
    predictable = np.flatnonzero(share < limits.max_fold_share)
    if share[predictable].sum() < limits.min_predictable_share:
        return float("nan")
    gain = 0.0
    for k in predictable:
        d = best_gain(s.sum(axis=0) - s[k], total - V[k], lower, upper, settings.score.min_information_share).step
        gain += float(2.0 * s[k] @ d - d @ V[k] @ d)
    return gain
