"""Check loads: loads that were applied and kept out of the fit, against those that the calibration model computes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.convergence import EXTRAPOLATION_MARGIN
from balance_cli.calibration.load_series import MIN_LOAD_CHANGE
from balance_cli.calibration.math_model import CONFIDENCE, CalibrationModel
from balance_cli.calibration.noise import APPLIED_SHARE, CalibrationNoise
from balance_cli.signals import distributions as stats

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SAME_LOAD_TOLERANCE = 1e-3
"""Share of the calibrated range within which two loads count as the same: a tenth of the smallest load step."""
MAX_ZERO_SHIFT = 4.0
"""Standard errors by which the zero of a run without tare point may differ from that of the calibration to equal it."""


@dataclass(frozen=True)
class CheckLoads:
    """Loads of a held-out run: applied (m, k) and computed (m, k) [N, N m], with half the prediction interval (m, k).

    `is_valid` (m,): rows within the calibrated loads for which the iteration converged.
    """

    run: str
    applied: Array
    computed: Array = field(metadata={"stored_as": "found"})
    prediction_interval: Array = field(metadata={"stored_as": "interval"})
    is_valid: NDArray[np.bool_] = field(metadata={"stored_as": "solved"})

    @property
    def interval_coverage(self) -> Array:
        """Share (k,) of the valid rows whose load lies within its prediction interval; NaN where none is known."""
        within = (np.abs(self.computed - self.applied) <= self.prediction_interval)[self.is_valid]
        if not len(within) or not np.isfinite(self.prediction_interval[self.is_valid]).all():
            return np.full(within.shape[1], np.nan)
        return np.asarray(np.mean(within, axis=0))

    @property
    def error(self) -> Array:
        """Rms error (k,) [N, N m] of the valid rows; NaN without any."""
        errors = (self.computed - self.applied)[self.is_valid]
        return np.asarray(np.sqrt(np.mean(errors**2, axis=0))) if len(errors) else np.full(errors.shape[1], np.nan)


@dataclass(frozen=True)
class _Zero:
    """Readings (m, c) [V] of the unloaded rig in each row, and their variance (c,) [V2]."""

    readings: Array
    variance: Array


def evaluate_check_loads(
    model: CalibrationModel,
    noise: CalibrationNoise,
    run: str,
    channels: Array,
    loads: Array,
    weight: Array | None = None,
) -> CheckLoads:
    """Compute the loads of a held-out run from its readings (m, c) [V], with their prediction intervals.

    The rows at the load (m, k) [N, N m] with which the run begins determine its zero: their mean reading less that of
    the model. Where that load is one of many and no tare point, a zero that does not differ from that of the
    calibration equals it. The interval includes the noise of a load reading where that load was applied. `weight`
    (m, k): loads of the metric part in addition to those applied.
    """
    added = np.zeros_like(loads) if weight is None else weight
    tare = np.all(np.abs(loads - loads[0]) <= SAME_LOAD_TOLERANCE * model.calibrated_range, axis=1)
    variance = np.diag(noise.reading_covariance) / np.count_nonzero(tare)
    zero = np.mean(channels[tare] - model.readings((loads + added)[tare]), axis=0)
    is_loaded = np.any(np.abs(loads[0]) > MIN_LOAD_CHANGE * model.calibrated_range)
    if is_loaded and np.count_nonzero(tare) == 1 and len(model.zeros) == 1:
        shift = (zero - model.zeros[0]) / np.sqrt(np.diag(model.residual_covariance) + model.zero_sigma[0] ** 2)
        if np.all(np.abs(shift) <= MAX_ZERO_SHIFT):
            zero, variance = model.zeros[0], model.zero_sigma[0] ** 2
    return _computed_loads(model, noise, run, channels, loads, added, _Zero(zero[None], variance))


def evaluate_check_points(
    model: CalibrationModel, noise: CalibrationNoise, run: str, channels: Array, loads: Array, series: NDArray[np.intp]
) -> CheckLoads:
    """Compute the loads of check points among the load series of the fit, whose zeros they share.

    `series` (m,): index of the zero of each row; `loads` (m, k) [N, N m] include the weight of the metric part where
    the model does.
    """
    zero = _Zero(model.zeros[series], np.mean(model.zero_sigma[series] ** 2, axis=0))
    return _computed_loads(model, noise, run, channels, loads, np.zeros_like(loads), zero)


def _computed_loads(
    model: CalibrationModel,
    noise: CalibrationNoise,
    run: str,
    channels: Array,
    loads: Array,
    added: Array,
    zero: _Zero,
) -> CheckLoads:
    computed, is_valid = model.loads(channels - zero.readings)
    beyond = (EXTRAPOLATION_MARGIN - 1.0) * model.calibrated_range
    is_valid &= np.all((computed <= model.largest_load + beyond) & (computed >= model.smallest_load - beyond), axis=1)
    interval = np.full(computed.shape, np.nan)
    if is_valid.any():
        interval[is_valid] = _prediction_interval(model, noise, computed[is_valid], loads[is_valid], zero.variance)
    return CheckLoads(run, loads, computed - added, interval, is_valid)


def _prediction_interval(
    model: CalibrationModel, noise: CalibrationNoise, computed: Array, loads: Array, zero_variance: Array
) -> Array:
    """Half-width (m, k) [N, N m] of the prediction interval of computed loads (m, k)."""
    S = noise.reading_covariance
    # The errors of the zero are correlated between the channels as their noise is.
    growth = np.sqrt(1.0 + zero_variance / np.diag(S))
    reading_interval = model.interval(computed, S * growth[:, None] * growth)
    applied = np.abs(loads) > APPLIED_SHARE * model.calibrated_range
    factor = float(stats.t.ppf(0.5 + 0.5 * CONFIDENCE, float(model.dof.min())))
    return np.asarray(np.hypot(reading_interval, factor * applied * noise.load_sigma * model.calibrated_range))
