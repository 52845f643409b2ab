"""Calibrations that do not describe their own loads: large residuals that repeated load points do not explain.

Sigma of loads contains the residual. What caused it (series that contradict each other, loads of another unit) may be
an error of the model as a whole, which no sigma describes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.all_trims_result import AllTrimsCalibration
from balance_cli.calibration.load_residuals import computed_loads

Array = NDArray[np.float64]

MIN_PERCENT = 1.0
"""Standard deviation of the back-calculated loads, percent of the calibrated range, from which it is large: balances
reach 0.05 to 0.5 %, and 1 % is what a rotor balance of plain load cells is built for."""
MIN_SCATTER_RATIO = 3.0
"""The same over the scatter of points repeated in a series: below, the readings are no better, and sigma says so."""
MIN_REPEATS = 5
"""Degrees of freedom of that scatter from which it is known to about a third."""
SAME_LOAD = 1e-4
"""Difference of two loads, in units of the calibrated range, that counts as none."""


@dataclass(frozen=True)
class LargeResidual:
    """The residual of a component, and the scatter of its repeated points, percent of the calibrated range.

    `scatter` is NaN where too few points were repeated.
    """

    component: str
    percent: float
    scatter: float


def large_residuals(all_trims: AllTrimsCalibration | None) -> tuple[LargeResidual, ...]:
    """Return the components whose back-calculated loads are far from the applied ones, the worst first."""
    if all_trims is None or not len(all_trims.loads):
        return ()
    used, model = all_trims.used, all_trims.model
    percent = 100.0 * (computed_loads(all_trims) - all_trims.loads)[used] / model.calibrated_range
    percent = percent[np.isfinite(percent).all(axis=1)]
    if not len(percent):
        return ()
    dof_share = max(float(np.mean(model.dof)), 1.0) / int(np.count_nonzero(used))
    residual = np.sqrt(np.mean(percent**2, axis=0) / dof_share)
    scatter = _repeat_scatter(all_trims) if residual.max() > MIN_PERCENT else residual
    large = (residual > MIN_PERCENT) & ~(residual < MIN_SCATTER_RATIO * scatter)
    order = np.argsort(-residual)
    return tuple(LargeResidual(model.components[j], residual[j], scatter[j]) for j in order.tolist() if large[j])


def _repeat_scatter(all_trims: AllTrimsCalibration) -> Array:
    """Standard deviation (k,) of the computed loads of repeated points, percent of the range; NaN with few of them."""
    used = all_trims.used
    x = all_trims.loads[used] / all_trims.model.calibrated_range
    found = 100.0 * computed_loads(all_trims)[used] / all_trims.model.calibrated_range
    # The same load in two series tells whether these agree, and not how a reading scatters.
    series = all_trims.run if all_trims.load_series is None else all_trims.load_series
    keys = np.column_stack([series[used], np.round(x / SAME_LOAD)])
    group = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)
    is_loaded, is_known = np.any(np.abs(x) > SAME_LOAD, axis=1), np.isfinite(found).all(axis=1)
    # Weights and levers scatter under load alone; noise of the readings shows without it, too.
    parts = [_scatter_in_groups(found[rows], group[rows]) for rows in (is_loaded & is_known, ~is_loaded & is_known)]
    return np.asarray(np.fmax(*parts))


def _scatter_in_groups(found: Array, group: NDArray[np.intp]) -> Array:
    """Standard deviation (k,) of loads (r, k) about the mean of each group (r,); NaN with few repetitions."""
    squares, dof = np.zeros(found.shape[1]), 0
    for name in np.unique(group).tolist():
        own = found[group == name]
        squares += np.sum((own - own.mean(axis=0)) ** 2, axis=0)
        dof += len(own) - 1
    return np.sqrt(squares / dof) if dof >= MIN_REPEATS else np.full(found.shape[1], np.nan)


def describe_large_residuals(large: tuple[LargeResidual, ...]) -> str:
    """Say how far the back-calculated loads are from the applied ones; empty where none is."""
    if not large:
        return ""
    values = ", ".join(f"{each.component} {each.percent:.2g} %" for each in large)
    known = all(np.isfinite(each.scatter) for each in large)
    scatter = f" where repeated points scatter by {max(each.scatter for each in large):.2g} %" if known else ""
    return (
        "the calibration does not describe its own loads: back-calculated less applied loads have a standard deviation "
        f"of {values} of the calibrated range{scatter}. Its rows contradict each other, or no term describes them"
    )
