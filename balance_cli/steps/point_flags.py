"""Flags of the static loads of points: what speaks against each row, in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.reduction.flags import (
    EXTRAPOLATED,
    MODEL_CONTRADICTED,
    NO_WEIGHT,
    NO_ZERO,
    REDUNDANCY,
    SEPARATOR,
    UNTESTED,
)

Array = NDArray[np.float64]

EXTRAPOLATION_SIGMAS = 2.0
"""Standard deviations of a load by which it must exceed the applied loads: the largest itself is read with noise."""
MOST_MARGIN = 0.1
"""Of the calibrated range, the same at most: a load of unknown zero is outside, however uncertain it is."""
NOT_CONVERGED = "not converged"
"""Flag of a row whose loads the iteration did not find; its loads are empty."""


@dataclass(frozen=True)
class RowTests:
    """What is known of each row beside its loads.

    `misfit` (n,): its redundant channels contradict; `unknown_weight` (n,): it has another attitude than its zero.
    `no_zero`: the zero is that of the calibration; `untested` (n, k): loads that no redundant sensor tests.
    `untested_names` (n): components that rest on products of loads that the calibration could not tell. `doubted`
    (n, k): loads that depend on which of its load series is right.
    """

    misfit: NDArray[np.bool_]
    unknown_weight: NDArray[np.bool_]
    no_zero: bool
    untested: NDArray[np.bool_]
    untested_names: Sequence[tuple[str, ...]]
    doubted: NDArray[np.bool_]


def point_flags(model: CalibrationModel, loads: Array, covariance: Array, tests: RowTests) -> tuple[str, ...]:
    """Flags (n,) of loads (n, k) with covariance (n, k, k)."""
    flags = []
    words_of_untested = [_untested_words(model.components, row) for row in tests.untested]
    rows = zip(loads, covariance, tests.misfit, tests.unknown_weight, tests.untested_names, tests.doubted, strict=True)
    for (row, S, misfits, unknown, names, doubted), untested in zip(rows, words_of_untested, strict=True):
        extrapolated = {*_extrapolated(model, row, S), *names} if np.isfinite(row).all() else set()
        outside = [name for name in model.components if name in extrapolated]
        words = (
            NO_ZERO if tests.no_zero else "",
            NO_WEIGHT if unknown else "",
            untested,
            REDUNDANCY if misfits else "",
            f"{EXTRAPOLATED} {' '.join(outside)}" if outside else "",
            " ".join([MODEL_CONTRADICTED, *np.array(model.components)[doubted]]) if doubted.any() else "",
            "" if np.isfinite(row).all() else NOT_CONVERGED,
        )
        flags.append(SEPARATOR.join(word for word in words if word))
    return tuple(flags)


def _untested_words(components: Sequence[str], untested: NDArray[np.bool_]) -> str:
    """Return the flag of the untested loads (k,) of a row: of all of them without names."""
    if untested.all():
        return UNTESTED
    return " ".join([UNTESTED, *np.array(components)[untested]]) if untested.any() else ""


def _extrapolated(model: CalibrationModel, loads: Array, covariance: Array) -> tuple[str, ...]:
    """Components whose load (k,) is outside the applied loads by more than its own uncertainty."""
    sigma = np.nan_to_num(np.sqrt(np.diagonal(covariance)))
    margin = np.minimum(EXTRAPOLATION_SIGMAS * sigma, MOST_MARGIN * model.calibrated_range)
    outside = (loads > model.largest_load + margin) | (loads < model.smallest_load - margin)
    return tuple(name for name, is_outside in zip(model.components, outside, strict=True) if is_outside)
