"""Cross-validation of one step: what a candidate gains on blocks of lines that its step has not seen.

Near the null chi-square is a parabola. With J the change of all parameters by the candidate's own, the fitted ones
following, gradient g_k and information I_k of fold k leave s_k = -J'g_k and V_k = J'I_k J. The step d that the other
folds would take gains 2 s_k'd - d'V_k d on fold k; all folds are added up. Blocks, not single lines: neighbours share
what is wrong with them.

The fitted parameters are not found anew without each fold. A mode's peak is narrower than a block, and without it the
rest of the lines say so little of that mode that the error of its frequency drowns what is asked.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.search.candidates import parameters_of_interest
from balance_cli.diagnosis.search.score_statistics import (
    Score,
    add_candidates,
    best_gain,
    extend_model,
    hold_other_parameters,
    one_sided_bounds,
)
from balance_cli.estimation.identifiability import covariance_from_information
from balance_cli.estimation.levenberg_marquardt import prior_curvature
from balance_cli.estimation.likelihood import Curvature, data_curvature
from balance_cli.estimation.measurements import Batch, select_lines
from balance_cli.model.balance import BalanceModel

Array = NDArray[np.float64]
Index = NDArray[np.intp]

FOLDS = 8
BLOCK = 8
# A fold that holds more of the information than this leaves too little elsewhere to foretell it.
MAX_FOLD_SHARE = 0.8
# Share of the information that must be in folds which can be foretold.
MIN_PREDICTABLE_SHARE = 0.5


def folds(batches: Sequence[Batch]) -> tuple[tuple[Batch, ...], ...]:
    """The lines in FOLDS parts: blocks of each run's lines in turn, of runs with few lines single ones.

    Every run begins with another fold: what is one line in each (the mean) shall not come together.
    """
    number = [_fold_numbers(batch, sum(len(other.runs) for other in batches[:i])) for i, batch in enumerate(batches)]
    return tuple(
        tuple(select_lines(batch, mine == fold) for batch, mine in zip(batches, number, strict=True))
        for fold in range(FOLDS)
    )


def _fold_numbers(batch: Batch, first: int) -> Index:
    fold = np.zeros(len(batch.index), np.intp)
    for run, part in enumerate(batch.parts):
        count = part.stop - part.start
        block = BLOCK if count >= 2 * FOLDS * BLOCK else 1
        fold[part] = (np.arange(count) // block + first + run) % FOLDS
    return fold


def cross_validation_gain(model: BalanceModel, theta: Array, batches: Sequence[Batch], score: Score) -> float:
    """What the candidate gains in chi-square on lines from which its step was not taken.

    NaN where nearly all that is known of it is in one fold.
    """
    geometry = add_candidates(model.geometry, [(score.candidate, score.start)])
    wide, at = extend_model(model, theta, geometry)
    items = parameters_of_interest(score.candidate.one.parameters)
    names = [score.candidate.one.full_name(item) for item in items]
    wide = hold_other_parameters(wide, model, set(names))
    system, prior = wide.system(at), prior_curvature(wide.parameters, at)
    parts = [data_curvature(fold, system) for fold in folds(batches)]
    free = [name for name, is_free in zip(wide.parameters.names, wide.parameters.free, strict=True) if is_free]
    J = _parameter_sensitivity(sum(parts, prior), np.array([free.index(name) for name in names], np.intp))
    s = np.array([-J.T @ part.gradient for part in parts])
    V = np.array([J.T @ part.information @ J for part in parts])
    return _predicted_gain(s, V, *one_sided_bounds(items))


def _parameter_sensitivity(total: Curvature, own: Index) -> Array:
    """J (p, q): the change of all parameters by the candidate's own, the fitted ones following."""
    fitted = np.setdiff1d(np.arange(len(total.gradient)), own)
    J = np.zeros((len(total.gradient), len(own)))
    J[own] = np.eye(len(own))
    J[fitted] = (
        -covariance_from_information(total.information[np.ix_(fitted, fitted)]) @ total.information[np.ix_(fitted, own)]
    )
    return J


def _predicted_gain(s: Array, V: Array, lower: NDArray[np.bool_], upper: NDArray[np.bool_]) -> float:
    """Gain of each fold's s (K, q) and V (K, q, q) by the step of the others, added up."""
    whole = covariance_from_information(V.sum(axis=0))
    share = np.trace(whole @ V, axis1=1, axis2=2) / max(np.trace(whole @ V.sum(axis=0)), 1e-300)
    judged = np.flatnonzero(share < MAX_FOLD_SHARE)
    if share[judged].sum() < MIN_PREDICTABLE_SHARE:
        return float("nan")
    gain = 0.0
    for k in judged:
        d = best_gain(s.sum(axis=0) - s[k], V.sum(axis=0) - V[k], lower, upper).step
        gain += float(2.0 * s[k] @ d - d @ V[k] @ d)
    return gain
