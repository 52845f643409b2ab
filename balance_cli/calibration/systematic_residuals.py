"""Residuals that follow one simple cause: gains that drift over the schedule, or a load that all loaded rows lack.

No term of loads describes either, and sigma holds only what they leave in the rows of the calibration itself.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.block_zeros import subtract_block_means
from balance_cli.calibration.fit import CalibrationModelFit, CalibrationPoints
from balance_cli.calibration.terms import term_values

Array = NDArray[np.float64]

MIN_EXPLAINED = 0.5
"""Share of the squares of the residuals that one cause must remove: of noise alone a column removes one in the rows."""
MIN_DRIFT = 0.003
"""Change of the gains over the schedule that is named: supplies and amplifiers hold a tenth of a percent in a day."""
MIN_LACK = 0.003
"""Load, over the calibrated range, that loaded rows lack: weights and hangers are known to 0.1 %."""
MIN_ROWS = 5
"""Unloaded rows, and loaded ones, from which both are told apart."""
MIN_POWER = 1e-3
"""Mean square of what the model does not follow of loaded or not, from which a step is told from the loads."""


def systematic_residual_notes(points: CalibrationPoints, fit: CalibrationModelFit) -> Iterator[str]:
    """Yield a sentence for gains of all channels that drift, and for a load that loaded rows lack."""
    used, model = np.asarray(np.isfinite(fit.residuals).all(axis=1)), fit.model
    sigma = np.maximum(np.sqrt(np.diag(model.residual_covariance)), np.finfo(float).tiny)
    residuals = subtract_block_means(fit.residuals[used], points.load_series[used]) / sigma
    rows = np.linspace(-0.5, 0.5, len(residuals))[:, None]
    shape = _beyond_model(points, fit, rows * model.readings(points.loads[used])) / sigma
    product, power = float(np.sum(shape * residuals)), max(float(np.sum(shape**2)), np.finfo(float).tiny)
    drift = product / power
    if drift * product > MIN_EXPLAINED * float(np.sum(residuals**2)) and abs(drift) > MIN_DRIFT:
        yield (
            f"all channels change by about {100.0 * drift:+.2g} % of their readings from the first to the last row: a "
            "supply or an amplifier drifts; record its voltage with the readings, or calibrate again"
        )
    is_loaded = np.any(points.x[used] != 0.0, axis=1)
    if min(np.count_nonzero(is_loaded), np.count_nonzero(~is_loaded)) >= MIN_ROWS:
        step = _beyond_model(points, fit, np.repeat(is_loaded[:, None].astype(float), residuals.shape[1], axis=1))
        yield from _lacking_loads(points, fit, step, residuals * sigma)


def _lacking_loads(points: CalibrationPoints, fit: CalibrationModelFit, step: Array, residuals: Array) -> Iterator[str]:
    """Yield a sentence where a `step` (m, c) of all loaded rows removes most of the residuals (m, c) of a channel."""
    model, power = fit.model, np.sum(step**2, axis=0)
    if power.min() < MIN_POWER * len(step):
        return
    jump = np.sum(step * residuals, axis=0) / power
    removed = power * jump**2 / np.maximum(np.sum(residuals**2, axis=0), np.finfo(float).tiny)
    loads = model.inverse() @ jump
    lacks = np.flatnonzero(np.abs(loads) > MIN_LACK)
    if removed.max() > MIN_EXPLAINED and len(lacks):
        names = ", ".join(f"{model.components[j]} {loads[j] * model.calibrated_range[j]:+.3g}" for j in lacks.tolist())
        yield (
            "the loads of all loaded rows lack a constant part that the unloaded rows do not have, about "
            f"{names} (N, N m): a hanger or pan, or a jump of the readings at zero? Add its weight to them, or take "
            "the tare with it"
        )


def _beyond_model(points: CalibrationPoints, fit: CalibrationModelFit, values: Array) -> Array:
    """What the zeros and the terms of each channel do not follow of values (m, c) in the rows that are fitted."""
    used = np.asarray(np.isfinite(fit.residuals).all(axis=1))
    series = points.load_series[used]
    columns = subtract_block_means(term_values(fit.model.parsed_terms, points.x[used]), series)
    left = subtract_block_means(values, series)
    for c, coefficients in enumerate(fit.model.coefficients.T):
        own = columns[:, coefficients != 0.0]
        left[:, c] -= own @ np.linalg.lstsq(own, left[:, c], rcond=None)[0]
    return left
