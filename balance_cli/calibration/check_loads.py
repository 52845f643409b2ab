"""Check loads: loads that were applied and kept out of the fit, against those that the calibration model computes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.all_trims_result import CheckLoads
from balance_cli.calibration.check_zeros import CheckZero, zeros_of_run
from balance_cli.calibration.convergence import EXTRAPOLATION_MARGIN
from balance_cli.calibration.load_series import MIN_LOAD_CHANGE
from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.noise import APPLIED_SHARE, CalibrationNoise
from balance_cli.calibration.noniterative_model import NonIterativeModel
from balance_cli.calibration.untested_products import UntestedProducts
from balance_cli.signals import distributions as stats
from balance_cli.signals.distributions import CONFIDENCE

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SAME_LOAD_TOLERANCE = 1e-3
"""Share of the calibrated range within which two loads count as the same: a tenth of the smallest load step."""
NON_ITERATIVE = "non-iterative method"
"""Name of the other method; stored in artefacts."""
MAX_ZERO_SHIFT = 4.0
"""Standard errors by which the zero of a run without tare point may differ from that of the calibration to equal it."""


class HeldOutRun(NamedTuple):
    """Readings (m, c) [V] and loads (m, k) [N, N m] of a held-out run, and the directions of gravity (m, 3) in it."""

    name: str
    channels: Array
    loads: Array
    gravity: Array | None = None


@dataclass(frozen=True)
class CheckModels:
    """The models that held-out loads check: the calibration model with its noise, and the other method where fitted.

    `untested`: products of two loads that the calibration could not tell.
    """

    model: CalibrationModel
    noise: CalibrationNoise
    non_iterative: NonIterativeModel | None = None
    untested: UntestedProducts | None = None

    def add_untested(self, interval: Array, loads: Array) -> Array:
        """The interval (m, k) [N, N m] widened by the untested products at loads (m, k)."""
        if self.untested is None:
            return interval
        variance = np.diagonal(self.untested.load_covariance(self.model, loads), axis1=1, axis2=2)
        return np.asarray(np.hypot(interval, stats.norm.ppf(0.5 + 0.5 * CONFIDENCE) * np.sqrt(variance)))


def evaluate_check_loads(
    models: CheckModels, run: str, channels: Array, loads: Array, weight: Array | None = None
) -> tuple[CheckLoads, ...]:
    """Compute the loads of a held-out run from its readings (m, c) [V], with their prediction intervals.

    The rows at the load (m, k) [N, N m] with which the run begins determine its zero, or unloaded ones: their mean
    reading less that of the model. Where the run returns to that load and its zeros differ, each load series has its
    own. Where that load is one of many and no tare point, a zero that does not differ from that of the calibration
    equals it. The interval includes the noise of a load reading where that load was applied. `weight`
    (m, k): loads of the metric part in addition to those applied. One result for each of the models.
    """
    model, noise = models.model, models.noise
    added = np.zeros_like(loads) if weight is None else weight
    tare = _tare_rows(loads, model.calibrated_range)
    unloaded = channels - model.readings(loads + added)
    zero = zeros_of_run(unloaded, tare, np.diag(noise.reading_covariance), float(model.dof.min()))
    is_loaded = np.any(np.abs(loads[tare][0]) > MIN_LOAD_CHANGE * model.calibrated_range)
    if is_loaded and np.count_nonzero(tare) == 1 and len(model.zeros) == 1:
        sigma = np.sqrt(np.diag(model.residual_covariance) + model.zero_sigma[0] ** 2)
        shift = (zero.readings[0] - model.zeros[0]) / sigma
        if np.all(np.abs(shift) <= MAX_ZERO_SHIFT):
            zero = CheckZero(model.zeros[:1], model.zero_sigma[0] ** 2)
    return _by_all_models(models, run, channels, loads, added, zero)


def _tare_rows(loads: Array, calibrated_range: Array) -> Mask:
    """Rows (m,) that tell the zero: those at the first load, or unloaded ones where the run begins with another."""
    tolerance = SAME_LOAD_TOLERANCE * calibrated_range
    unloaded = np.all(np.abs(loads) <= tolerance, axis=1)
    if unloaded.any() and np.any(np.abs(loads[0]) > MIN_LOAD_CHANGE * calibrated_range):
        return np.asarray(unloaded)
    return np.asarray(np.all(np.abs(loads - loads[0]) <= tolerance, axis=1))


def evaluate_check_points(
    models: CheckModels, run: str, channels: Array, loads: Array, series: NDArray[np.intp]
) -> tuple[CheckLoads, ...]:
    """Compute the loads of check points among the load series of the fit, whose zeros they share.

    `series` (m,): index of the zero of each row; `loads` (m, k) [N, N m] include the weight of the metric part where
    the model does.
    """
    zero = CheckZero(models.model.zeros[series], np.mean(models.model.zero_sigma[series] ** 2, axis=0))
    return _by_all_models(models, run, channels, loads, np.zeros_like(loads), zero)


def _by_all_models(
    models: CheckModels, run: str, channels: Array, loads: Array, added: Array, zero: CheckZero
) -> tuple[CheckLoads, ...]:
    first = _computed_loads(models, run, channels, loads, added, zero)
    if models.non_iterative is None:
        return (first,)
    return first, _non_iterative_loads(models, run, channels, loads, added, zero)


def _non_iterative_loads(
    models: CheckModels, run: str, channels: Array, loads: Array, added: Array, zero: CheckZero
) -> CheckLoads:
    """Check loads by the non-iterative method; its residuals contain the noise of readings and of applied loads."""
    model, other = models.model, models.non_iterative
    assert other is not None
    change = channels - zero.readings
    computed = other.loads(change)
    covariance = _zero_covariance(models.noise.reading_covariance, zero.variance)
    interval = other.prediction_interval(change, covariance)
    truncation = stats.norm.ppf(0.5 + 0.5 * CONFIDENCE) * other.truncation(change, model)
    return CheckLoads(
        run=run,
        applied=loads,
        computed=computed - added,
        prediction_interval=models.add_untested(np.hypot(interval, truncation), computed),
        is_valid=_within_calibrated_loads(model, computed),
        method=NON_ITERATIVE,
        zeros=zero.note,
    )


def _within_calibrated_loads(model: CalibrationModel, computed: Array) -> Mask:
    beyond = (EXTRAPOLATION_MARGIN - 1.0) * model.calibrated_range
    inside = (computed <= model.largest_load + beyond) & (computed >= model.smallest_load - beyond)
    return np.asarray(np.all(inside, axis=1))


def _zero_covariance(S: Array, zero_variance: Array) -> Array:
    """Covariance (c, c) of a zero; its errors are correlated between the channels as the noise S of their readings."""
    growth = np.sqrt(zero_variance / np.diag(S))
    return np.asarray(S * growth[:, None] * growth)


def _computed_loads(
    models: CheckModels, run: str, channels: Array, loads: Array, added: Array, zero: CheckZero
) -> CheckLoads:
    model, noise = models.model, models.noise
    computed, is_valid = model.loads(channels - zero.readings)
    is_valid &= _within_calibrated_loads(model, computed)
    interval = np.full(computed.shape, np.nan)
    if is_valid.any():
        known = _prediction_interval(model, noise, computed[is_valid], loads[is_valid], zero.variance)
        interval[is_valid] = models.add_untested(known, computed[is_valid])
    return CheckLoads(run, loads, computed - added, interval, is_valid, zeros=zero.note)


def _prediction_interval(
    model: CalibrationModel, noise: CalibrationNoise, computed: Array, loads: Array, zero_variance: Array
) -> Array:
    """Half-width (m, k) [N, N m] of the prediction interval of computed loads (m, k)."""
    S = noise.reading_covariance
    # The errors of the zero are correlated between the channels as their noise is.
    growth = np.sqrt(1.0 + zero_variance / np.diag(S))
    reading_interval = np.sqrt(model.weight_widening()) * model.interval(computed, S * growth[:, None] * growth)
    applied = np.abs(loads) > APPLIED_SHARE * model.calibrated_range
    factor = float(stats.t.ppf(0.5 + 0.5 * CONFIDENCE, float(model.dof.min())))
    return np.asarray(np.hypot(reading_interval, factor * applied * noise.load_sigma * model.calibrated_range))
