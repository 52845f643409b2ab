"""Which model computes loads from readings: its name, and the choice where a calibration has two."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from balance_cli.io.errors import UserError

if TYPE_CHECKING:
    from balance_cli.calibration.all_trims_result import AllTrimsCalibration
    from balance_cli.calibration.result import Calibration

ITERATIVE, LINEAR, NON_ITERATIVE = "iteration with the calibration model", "linear model", "non-iterative method"
RANDOM_TERMS, MATRIX = "iteration with random nonlinear terms", "matrix of trim"
ITERATION_ONLY = "iterative"
"""The choice without the non-iterative method, which otherwise computes the loads where the calibration has it."""


def iteration_name(all_trims: AllTrimsCalibration) -> str:
    """Name of the model that computes loads without the non-iterative method."""
    if all_trims.random_terms is not None:
        return RANDOM_TERMS
    return ITERATIVE if all_trims.model.is_nonlinear else LINEAR


def choose_load_method(calibration: Calibration, method: str | None, place: str) -> Calibration:
    """The calibration with the method that was asked for by the option `place` (None: as it is) as its default.

    Raises UserError where it has no model of that method.
    """
    if method is None:
        return calibration
    all_trims = calibration.all_trims
    if method == ITERATION_ONLY:
        without = None if all_trims is None else replace(all_trims, non_iterative=None)
        return replace(calibration, all_trims=without)
    if all_trims is None or all_trims.non_iterative is None:
        fault = "the calibration has no non-iterative model"
        raise UserError(fault, place, remedy="Calibrate with --non-iterative, or use the iteration")
    return calibration
