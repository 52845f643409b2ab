"""Back-calculated loads: loads computed from the readings of the calibration itself, less the applied ones.

This is the figure of merit of a balance calibration (AIAA R-091A-2020): residuals of each load component
in percent of its full scale, by the model that is actually used to compute loads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.all_trims_result import AllTrimsCalibration
from balance_cli.calibration.load_method import NON_ITERATIVE, iteration_name
from balance_cli.calibration.result import Calibration
from balance_cli.campaign.rig.load_components import FullScale, full_scale

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LoadResiduals:
    """Applied and computed loads (m, k) [N, N m] of all rows; NaN for rows that were excluded from the fit.

    `run` (m,) is an index into `runs`, `row` (m,) the number of the row in its run, from 1. `dof_share`: degrees of
    freedom of the fit over its rows, which corrects the standard deviation. `method`: the model that was used.
    """

    components: tuple[str, ...]
    full_scale: FullScale
    runs: tuple[str, ...]
    run: NDArray[np.intp]
    row: NDArray[np.intp]
    applied: Array
    computed: Array
    dof_share: float
    method: str

    @property
    def percent(self) -> Array:
        """Computed less applied loads (m, k) in percent of full scale."""
        return np.asarray(100.0 * (self.computed - self.applied) / self.full_scale.values)

    @property
    def used(self) -> NDArray[np.bool_]:
        """Rows (m,) that were fitted."""
        return np.asarray(np.isfinite(self.computed).all(axis=1))

    @property
    def standard_deviation(self) -> Array:
        """Standard deviation (k,) in percent of full scale, with the degrees of freedom of the fit."""
        return np.asarray(np.sqrt(np.mean(self.percent[self.used] ** 2, axis=0) / self.dof_share))

    @property
    def largest(self) -> tuple[Array, NDArray[np.intp]]:
        """Residual of largest size (k,) in percent of full scale, and the index (k,) of its row."""
        at = np.argmax(np.where(self.used[:, None], np.abs(self.percent), -1.0), axis=0)
        return np.asarray(self.percent[at, np.arange(len(at))]), np.asarray(at, np.intp)


def load_residuals(calibration: Calibration) -> LoadResiduals | None:
    """Compute the loads of all rows that were fitted, by the model that `reduce` and `apply` use.

    None for a calibration from a matrix, which has no rows, without a calibration model of all trims, and where its
    iteration gives no loads.
    """
    all_trims = calibration.all_trims
    if all_trims is None or not len(all_trims.loads):
        return None
    model, used = all_trims.loads_model, all_trims.used
    computed = computed_loads(all_trims)
    if not np.isfinite(computed).any():
        return None
    return LoadResiduals(
        components=model.components,
        full_scale=full_scale(calibration.geometry, model.components, model.calibrated_range),
        runs=all_trims.runs,
        run=all_trims.run,
        row=_row_numbers(all_trims.run),
        applied=all_trims.loads,
        computed=computed,
        dof_share=max(float(np.mean(model.dof)), 1.0) / int(np.count_nonzero(used)),
        method=iteration_name(all_trims) if all_trims.non_iterative is None else NON_ITERATIVE,
    )


def computed_loads(all_trims: AllTrimsCalibration) -> Array:
    """Return the loads (m, k) [N, N m] of the rows that were fitted by the model or method that computes loads.

    NaN in the other rows, and where the iteration does not converge.
    """
    computed, used = np.full(all_trims.loads.shape, np.nan), all_trims.used
    change = _readings_less_zero(all_trims, used)
    if all_trims.non_iterative is not None:
        computed[used] = all_trims.non_iterative.loads(change)
        return computed
    loads, _ = all_trims.loads_model.loads(change)
    computed[used] = np.where(np.isfinite(loads).all(axis=1, keepdims=True), loads, np.nan)
    return computed


def _readings_less_zero(all_trims: AllTrimsCalibration, used: NDArray[np.bool_]) -> Array:
    """Readings (m, c) of the rows that were fitted, less the zeros of the model or method that computes the loads."""
    change = all_trims.model.readings(all_trims.loads[used]) + all_trims.residuals[used]
    if all_trims.random_terms is None or all_trims.non_iterative is not None or all_trims.load_series is None:
        return change
    series = np.unique(all_trims.load_series[used], return_inverse=True)[1]
    return np.asarray(change + (all_trims.model.zeros - all_trims.random_terms.zeros)[series])


def _row_numbers(run: NDArray[np.intp]) -> NDArray[np.intp]:
    """Number (m,) of each row in its run, from 1."""
    numbers = np.zeros(len(run), np.intp)
    for name in np.unique(run):
        rows = run == name
        numbers[rows] = np.arange(1, np.count_nonzero(rows) + 1)
    return numbers
