"""Hysteresis of a balance: reading while loading less reading while unloading, at the same load.

It is sought beside the model that computes the loads. In the residuals of a straight line curvature has the pattern of
a loop wherever the steps up and down of a load end at different loads, as in a random schedule.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.result import Calibration, Hysteresis
from balance_cli.calibration.static_matrices import (
    ColumnsFit,
    TrimRows,
    fit_columns,
    loading_directions,
    run_columns,
    standard_errors,
)
from balance_cli.calibration.terms import term_values
from balance_cli.io.errors import UserError
from balance_cli.signals import distributions as stats

Array = NDArray[np.float64]

LOOP_SIGNIFICANCE_LEVEL = 0.01
"""Probability of a false loop in any component of a calibration. A loop that is missed at three of its standard errors
is, with a dozen steps each way, less than the noise of a single row."""
MIN_ROWS_PER_COLUMN = 2.0
"""Rows for each column up to which the terms of the model stand beside the directions. With fewer the residuals tell no
standard error, and the part of the terms is taken off the readings."""


def estimate_hysteresis(
    rows: TrimRows, T0: Array, channel_names: tuple[str, ...], model: CalibrationModel | None = None
) -> Hysteresis:
    """Estimate the hysteresis of the rows of a trim beside its straight line and the nonlinear terms of a `model`.

    The direction of the last load change is one more regressor for each component; its coefficient is half the mean
    width of the loop. NaN where a component was not both loaded and unloaded. `T0` (k, c) refers channels to loads.
    """
    U = loading_directions(rows)
    c, k = rows.channels.shape[1], rows.loads.shape[1]
    both = (np.sum(U > 0, axis=0) >= 2) & (np.sum(U < 0, axis=0) >= 2)
    width, sigma = np.full((c, k), np.nan), np.full((c, k), np.nan)
    loads, loads_sigma = np.full(k, np.nan), np.full(k, np.nan)
    columns = int(rows.run[-1]) + 1 + k + rows.uncarried_loads.shape[1] + int(np.sum(both))
    if len(U) <= columns or not np.any(both):
        return Hysteresis(width, sigma, loads, loads_sigma)
    fit = _fit_beside_model(rows, U[:, both], channel_names, model)
    last = slice(len(fit.coefficients) - int(np.sum(both)), len(fit.coefficients))
    covariance = 4.0 * fit.covariance(last)
    width[:, both] = 2.0 * fit.coefficients[last].T
    sigma[:, both] = standard_errors(covariance)
    own = T0[both]
    loads[both] = np.einsum("kc,ck->k", own, width[:, both])
    loads_sigma[both] = np.sqrt(np.einsum("ki,ikjk,kj->k", own, covariance, own))
    return Hysteresis(width, sigma, loads, loads_sigma)


def _fit_beside_model(
    rows: TrimRows, directions: Array, channel_names: tuple[str, ...], model: CalibrationModel | None
) -> ColumnsFit:
    """Fit of zeros, loads and directions (m, d), which come last, beside the nonlinear terms of the model."""
    line = [run_columns(rows), rows.loads, rows.uncarried_loads]
    if model is None or model.calibrated_range.shape[0] != rows.loads.shape[1]:
        return fit_columns(np.hstack([*line, directions]), rows)
    rows, terms = _less_nonlinear_part(rows, channel_names, model)
    X = np.hstack([*line, terms, directions])
    if len(X) >= MIN_ROWS_PER_COLUMN * X.shape[1]:
        try:
            return fit_columns(X, rows)
        except UserError:  # terms of different channels that the schedule does not tell apart
            pass
    return fit_columns(np.hstack([*line, directions]), rows)


def _less_nonlinear_part(
    rows: TrimRows, channel_names: tuple[str, ...], model: CalibrationModel
) -> tuple[TrimRows, Array]:
    """The rows without the nonlinear part of the model, and its nonlinear terms (m, q).

    A weight that the loads of the model contain changes the squares by what is linear in the loads.
    """
    k = len(model.components)
    values = term_values(model.parsed_terms, rows.loads / model.calibrated_range)[:, k:]
    part = values @ model.coefficients[k:]
    channels = rows.channels.copy()
    for column, name in enumerate(model.channel_names):
        if name in channel_names:
            channels[:, channel_names.index(name)] -= part[:, column]
    return replace(rows, channels=channels), values[:, np.any(model.coefficients[k:] != 0.0, axis=1)]


def loop_covariance(calibration: Calibration) -> Array:
    """Variance (k, k) [N2, (N m)2] of loads of which nobody knows whether they were reached from above or from below.

    Half of the mean width of the loop in the trim where it is widest, less what noise makes of it; zero where no loop
    is significant among all that were tested. In a calibration the noise of the applied loads has the same pattern,
    and contains it; the readings of a test do not have that noise.
    """
    trims = list(calibration.trims.values())
    components = trims[0].components if calibration.all_trims is None else calibration.all_trims.model.components
    variance = np.zeros(len(components))
    tests = sum(int(np.count_nonzero(np.isfinite(trim.hysteresis.loads_sigma))) for trim in trims)
    for trim in trims:
        own = [j for j, name in enumerate(trim.components) if name in components]
        at = [components.index(trim.components[j]) for j in own]
        loop, sigma = trim.hysteresis.loads[own], trim.hysteresis.loads_sigma[own]
        limit = float(stats.t.isf(0.5 * LOOP_SIGNIFICANCE_LEVEL / max(tests, 1), max(trim.dof, 1)))
        excess = np.where(np.abs(loop) > limit * sigma, loop**2 - sigma**2, 0.0)
        variance[at] = np.maximum(variance[at], 0.25 * excess)
    return np.diag(variance)
