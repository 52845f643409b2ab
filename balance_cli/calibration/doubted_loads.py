"""Loads that change if a load series that was excluded is the right one, and those that outvoted it are wrong.

Series that share a mistake (an arm, a set of weights) agree with each other and exclude a sound one. Up to a clear
majority nothing in the calibration tells which is right.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.all_trims_result import AllTrimsCalibration
from balance_cli.calibration.combined_series import is_proportional
from balance_cli.calibration.contradiction import PLAUSIBLE_FACTORS
from balance_cli.calibration.load_series import MIN_LOAD_CHANGE, describe_load_series

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CLEAR_MAJORITY = 4
"""Load series of a load that agree, for each excluded one, from which they are right: a mistake is rarely made in so
many, as in two or three that hang on the same arm."""


def doubted_change(all_trims: AllTrimsCalibration | None, loads: Array) -> Array:
    """Return by what loads (n, k) [N, N m] of the model would change if the excluded load series were right, rms.

    Zero without excluded series, or with a clear majority against them. A gain beyond PLAUSIBLE_FACTORS is no case of
    doubt: there the declared rig has decided.
    """
    change = np.zeros(loads.shape)
    if all_trims is None or not all_trims.suspect_series or all_trims.load_series is None:
        return change
    model, k = all_trims.model, loads.shape[1]
    x = loads / model.calibrated_range
    response = model.coefficients[:k].T
    for effects, gain_errors in _excluded_series(all_trims, all_trims.load_series):
        for effect in effects:
            error = model.inverse() @ (gain_errors * (x @ effect @ response.T)).T
            change += (error.T * model.calibrated_range) ** 2
    return np.asarray(np.sqrt(change))


def add_doubted_change(all_trims: AllTrimsCalibration | None, loads: Array, covariance: Array) -> tuple[Array, Mask]:
    """Return the covariance (n, k, k) of loads (n, k) with half of the doubted change, and which exceed sigma (n, k).

    Of two values of which either may be right, 1.96 times half of their distance about one contains the other.
    """
    change = doubted_change(all_trims, loads)
    doubted = change > np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return covariance + (0.5 * change)[:, :, None] ** 2 * np.eye(loads.shape[1]), doubted


def _excluded_series(all_trims: AllTrimsCalibration, series: NDArray[np.intp]) -> list[tuple[list[Array], Array]]:
    """Return for each excluded load series matrices (k, k) from loads to those in doubt, and gain errors (c,) there."""
    model, x = all_trims.model, all_trims.loads / all_trims.model.calibrated_range
    moved, words, fitted = [], [], []
    for name in np.unique(series):
        rows = np.flatnonzero(series == name)
        of_run = np.flatnonzero(all_trims.run == all_trims.run[rows[0]])
        run = all_trims.runs[int(all_trims.run[rows[0]])]
        words.append(describe_load_series(rows - of_run[0], run, model.components, x[of_run]))
        moved.append(np.ptp(x[rows], axis=0) > MIN_LOAD_CHANGE)
        fitted.append(bool(np.isfinite(all_trims.residuals[rows]).any()))
    agreeing = np.sum([own for own, is_fitted in zip(moved, fitted, strict=True) if is_fitted], axis=0)
    excluded = {name for name, is_fitted in zip(words, fitted, strict=True) if not is_fitted}
    against = np.sum([own for own, name in zip(moved, words, strict=True) if name in excluded], axis=0)
    in_doubt = agreeing < CLEAR_MAJORITY * against
    return [
        (_effects(x[series == number], own, in_doubt), _gain_errors(all_trims, name))
        for number, own, name in zip(np.unique(series), moved, words, strict=True)
        if name in excluded
    ]


def _effects(x: Array, moved: Mask, in_doubt: Mask) -> list[Array]:
    """Return matrices (k, k) from loads to those of an excluded series, of rows x (r, k), that have its gain errors.

    Where its loads changed in proportion, all of what it contradicts may be an error of either of them.
    """
    if not is_proportional(x):
        return [np.diag((moved & in_doubt).astype(float))]
    direction = np.linalg.svd(x - x.mean(axis=0), full_matrices=False)[2][0]
    return [np.outer(np.eye(len(moved))[j], direction / direction[j]) for j in np.flatnonzero(moved & in_doubt)]


def _gain_errors(all_trims: AllTrimsCalibration, words: str) -> Array:
    """Return gain less one (c,) of the suspect channels of a load series; zero for the others."""
    low, high = PLAUSIBLE_FACTORS
    gain = {
        suspect.channel: suspect.gain - 1.0
        for suspect in all_trims.suspect_series
        if suspect.load_series == words and low <= suspect.gain <= high
    }
    return np.array([gain.get(name, 0.0) for name in all_trims.model.channel_names])


def describe_doubt(all_trims: AllTrimsCalibration) -> str:
    """Return what is in doubt in words."""
    names = ", ".join(dict.fromkeys(suspect.load_series for suspect in all_trims.suspect_series))
    return (
        f"load series of the calibration contradict each other ({names} excluded), and too few others tell which is "
        "right: sigma includes half of what the loads depend on it. Repeat that series"
    )
