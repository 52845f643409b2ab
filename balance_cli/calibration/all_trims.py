"""Calibration of all trims together: calibration model, zeros, outliers, and loads held out to check it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.convergence import EXTRAPOLATION_MARGIN
from balance_cli.calibration.fit import CalibrationPoints
from balance_cli.calibration.math_model import CONFIDENCE, CalibrationModel
from balance_cli.calibration.noise import APPLIED_SHARE, CalibrationNoise, estimate_calibration_noise
from balance_cli.calibration.noniterative import NonIterativeModel, fit_noniterative_model
from balance_cli.calibration.outliers import Outlier, SuspectLoadSeries, find_swapped_channels
from balance_cli.calibration.tares import Tares, screen_outliers_with_tares
from balance_cli.campaign.recording.run import Run, read_channels
from balance_cli.campaign.rig.attitude import gravity_directions
from balance_cli.campaign.rig.load_components import LoadComponents
from balance_cli.signals import distributions as stats

Array = NDArray[np.float64]
Index = NDArray[np.intp]
LEVEL_GRAVITY = gravity_directions([[0.0, 0.0]])
MIN_ZEROS = 3
"""Zeros that a drift rate with a residual needs: a line through two of them leaves no degree of freedom."""
SAME_LOAD_TOLERANCE = 1e-3
"""Share of the calibrated range within which two loads count as the same: a tenth of the smallest load step."""


@dataclass(frozen=True)
class Drift:
    """A straight line through the zeros of the load series in their order.

    `slope` (c,) [V per load series] with `slope_sigma` (c,); `chi2_per_dof` (c,): chi-square per degree of freedom of
    the zeros about the line, 1 where their standard errors explain the scatter. NaN for fewer than three load series.
    """

    slope: Array
    slope_sigma: Array
    chi2_per_dof: Array = field(metadata={"stored_as": "scatter"})


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
        """Share (k,) of the valid rows whose load lies within its prediction interval; NaN without any."""
        within = (np.abs(self.computed - self.applied) <= self.prediction_interval)[self.is_valid]
        return np.asarray(np.mean(within, axis=0)) if len(within) else np.full(within.shape[1], np.nan)

    @property
    def error(self) -> Array:
        """Rms error (k,) [N, N m] of the valid rows; NaN without any."""
        errors = (self.computed - self.applied)[self.is_valid]
        return np.asarray(np.sqrt(np.mean(errors**2, axis=0))) if len(errors) else np.full(errors.shape[1], np.nan)


@dataclass(frozen=True)
class AllTrimsCalibration:
    """Calibration model of all trims, with the rows that it was fitted to.

    Of each row: `run` (m,), an index into `runs`; `loads` (m, k) [N, N m]; `residuals` (m, c) and
    `cross_validation_errors` (m, c) [V], the latter predicted without the load series of the row. Both are NaN where a
    row was excluded. `attitude_segment` (m,): index of the attitude, None where no run states one.

    `outliers` and `suspect_series` were excluded from the fit. `swapped_channels`: pairs of channels that read each
    other's loads in all runs. `screening_notes`: where the search for outliers stopped early, and why the weight of the
    metric part is not determined. `non_iterative`: the model of that method, where it was requested.

    With `tares` the loads of the rows and of the model include the weight of the metric part, and the zeros are those
    of the balance without any load.
    """

    model: CalibrationModel
    runs: tuple[str, ...]
    run: Index
    loads: Array
    residuals: Array
    cross_validation_errors: Array = field(metadata={"stored_as": "left_out"})
    drift: Drift
    noise: CalibrationNoise
    outliers: tuple[Outlier, ...]
    suspect_series: tuple[SuspectLoadSeries, ...] = field(metadata={"stored_as": "bad_sequences"})
    swapped_channels: tuple[str, ...] = field(default=(), metadata={"stored_as": "exchanged"})
    screening_notes: tuple[str, ...] = field(default=(), metadata={"stored_as": "limits"})
    non_iterative: NonIterativeModel | None = field(default=None, metadata={"stored_as": "direct"})
    checks: tuple[CheckLoads, ...] = ()
    tares: Tares | None = None
    attitude_segment: Index | None = field(default=None, metadata={"stored_as": "stretch"})

    @property
    def level_weight_loads(self) -> Array:
        """Loads (k,) [N, N m] of the weight of the metric part on the level rig; zero where the tares are not known."""
        names = self.model.components
        return np.zeros(len(names)) if self.tares is None else self.tares.loads(LEVEL_GRAVITY, names)[0]


def calibrate_all_trims(
    points: CalibrationPoints,
    checks: Sequence[tuple[str, Array, Array]] = (),
    search: bool = True,
    declared: Array | None = None,
    non_iterative: bool = False,
    check_gravity: Mapping[str, Array] | None = None,
) -> AllTrimsCalibration:
    """Fit one calibration model to the points of all trims.

    `checks`: name, readings (m, c) [V] and loads (m, k) [N, N m] of each held-out run; `check_gravity`: directions of
    gravity (m, 3) in rig axes of those that state their attitude, by name. With the `declared` response (c, k)
    [V/N, V/(N m)] swapped channels are identified. With `non_iterative` the loads are also fitted as functions of the
    readings.

    Raises least_squares.CollinearError where a load was never applied without the others.
    """
    total, screened, tares = screen_outliers_with_tares(points, search)
    fit, model = screened.fit, screened.fit.model
    used = np.asarray(np.isfinite(fit.residuals).all(axis=1))
    C = model.coefficients[: len(model.components)].T
    noise = estimate_calibration_noise(fit.residuals[used], points.x[used], C, model.residual_covariance)
    return AllTrimsCalibration(
        model=model,
        runs=points.run_names,
        run=points.run,
        loads=total.loads,
        residuals=fit.residuals,
        cross_validation_errors=fit.cross_validation_errors,
        drift=fit_drift(model.zeros, fit.zero_covariance),
        noise=noise,
        outliers=screened.outliers,
        suspect_series=screened.suspect_series,
        swapped_channels=() if declared is None else find_swapped_channels(points, declared * points.calibrated_range),
        screening_notes=(*screened.screening_notes, *_runs_without_attitude(points)),
        non_iterative=fit_noniterative_model(total, model, used, search) if non_iterative else None,
        checks=tuple(
            evaluate_check_loads(model, noise, *check, _tare_loads(tares, model, (check_gravity or {}).get(check[0])))
            for check in checks
        ),
        tares=tares,
        attitude_segment=None if points.gravity is None else points.attitude_segment,
    )


def _tare_loads(tares: Tares | None, model: CalibrationModel, gravity: Array | None) -> Array | None:
    """Loads (m, k) of the weight of the metric part; None where it or the attitude is not known."""
    return None if tares is None or gravity is None else tares.loads(gravity, model.components)


def _runs_without_attitude(points: CalibrationPoints) -> Iterator[str]:
    """Notes on the runs that do not state an attitude while others do."""
    if points.gravity is None:
        return
    for run in np.unique(points.run[~np.isfinite(points.gravity).all(axis=1)]):
        name = points.run_names[run]
        yield f"run {name} does not state its attitude: the weight of the metric part cannot be determined"


def fit_drift(zeros: Array, covariance: Array) -> Drift:
    """Fit a straight line through the zeros (s, c) of the load series in their order.

    Generalized least squares with the covariance (c, s, s) of each channel's zeros (Aitken, 1935).
    """
    s, c = zeros.shape
    if s < MIN_ZEROS:
        return Drift(*(np.full(c, np.nan) for _ in range(3)))
    line = np.column_stack([np.ones(s), np.arange(s) - 0.5 * (s - 1)])
    slope, sigma, chi2_per_dof = np.zeros(c), np.zeros(c), np.zeros(c)
    for channel in range(c):
        weighted = np.linalg.solve(covariance[channel], np.column_stack([line, zeros[:, channel]]))
        inverse = np.linalg.inv(line.T @ weighted[:, :2])
        coefficients = inverse @ (line.T @ weighted[:, 2])
        residual = zeros[:, channel] - line @ coefficients
        slope[channel], sigma[channel] = coefficients[1], np.sqrt(inverse[1, 1])
        chi2_per_dof[channel] = residual @ np.linalg.solve(covariance[channel], residual) / (s - 2)
    return Drift(slope, sigma, chi2_per_dof)


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
    the model. The interval includes the noise of a load reading where that load was applied. `weight` (m, k): loads of
    the metric part in addition to those applied.
    """
    weight_loads_in_rows = np.zeros_like(loads) if weight is None else weight
    S = noise.reading_covariance
    tare = np.all(np.abs(loads - loads[0]) <= SAME_LOAD_TOLERANCE * model.calibrated_range, axis=1)
    zero = np.mean(channels[tare] - model.readings((loads + weight_loads_in_rows)[tare]), axis=0)
    computed, is_valid = model.loads(channels - zero)
    beyond = (EXTRAPOLATION_MARGIN - 1.0) * model.calibrated_range
    is_valid &= np.all((computed <= model.largest_load + beyond) & (computed >= model.smallest_load - beyond), axis=1)
    interval = np.full(computed.shape, np.nan)
    if is_valid.any():
        reading_interval = model.interval(computed[is_valid], S * (1.0 + 1.0 / np.count_nonzero(tare)))
        applied = np.abs(loads[is_valid]) > APPLIED_SHARE * model.calibrated_range
        load_interval = stats.norm.ppf(0.5 + 0.5 * CONFIDENCE) * applied * noise.load_sigma * model.calibrated_range
        interval[is_valid] = np.hypot(reading_interval, load_interval)
    return CheckLoads(run, loads, computed - weight_loads_in_rows, interval, is_valid)


def read_load_points(run: Run, channel_names: Sequence[str], components: LoadComponents) -> tuple[Array, Array]:
    """Read the readings (m, c) [V] and loads (m, k) [N, N m] of a static run."""
    loads = run.read().loads
    assert loads is not None
    return read_channels(run, channel_names), components.carried(loads)
