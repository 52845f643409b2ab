"""The whole calibration, all trims together: gage model, zeros, what is wrong in it, and loads that checked it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from balance_cli.calibration.convergence import EXTRAPOLATION_MARGIN
from balance_cli.calibration.fit import CalibrationPoints
from balance_cli.calibration.math_model import CONFIDENCE, CalibrationModel
from balance_cli.calibration.noise import APPLIED_SHARE, CalibrationNoise, estimate_calibration_noise
from balance_cli.calibration.noniterative import NonIterativeModel, fit_noniterative_model
from balance_cli.calibration.outliers import Outlier, SuspectLoadSeries, exchanged
from balance_cli.calibration.tares import Tares, screen_outliers_with_tares
from balance_cli.campaign.recording.run import Run, read_channels
from balance_cli.campaign.rig.attitude import gravity_directions
from balance_cli.campaign.rig.components import COMPONENTS

Array = NDArray[np.float64]
Index = NDArray[np.intp]
LEVEL_GRAVITY = gravity_directions([[0.0, 0.0]])


@dataclass(frozen=True)
class Drift:
    """Zeros over the order of the sequences: slope (c,) [V per sequence] with sigma, and how much more the zeros

    scatter about that line than their standard errors say, as chi-square per degree of freedom (c,). NaN for fewer than
    three sequences.
    """

    slope: Array
    slope_sigma: Array
    scatter: Array


@dataclass(frozen=True)
class CheckLoads:
    """Loads that took no part: applied (m, k) and found (m, k) [N, N m], half the prediction interval (m, k).

    `solved` (m,): rows within the range of the calibration, where the iteration holds.
    """

    run: str
    applied: Array
    found: Array
    interval: Array
    solved: NDArray[np.bool_]

    @property
    def interval_coverage(self) -> Array:
        """Share (k,) of the loads within their prediction interval, among rows that were solved; NaN without any."""
        within = np.abs(self.found - self.applied) <= self.interval
        return (
            np.asarray(np.mean(within[self.solved], axis=0)) if self.solved.any() else np.full(within.shape[1], np.nan)
        )

    @property
    def error(self) -> Array:
        """Rms error (k,) [N, N m] of the rows that were solved."""
        errors = (self.found - self.applied)[self.solved]
        return np.asarray(np.sqrt(np.mean(errors**2, axis=0))) if len(errors) else np.full(errors.shape[1], np.nan)


@dataclass(frozen=True)
class AllTrimsCalibration:
    """Gage model of all trims with the rows behind it: loads (m, k), residuals and errors of sequences left out (m, c)

    [V], NaN where a row took no part; `run` (m,) counts `runs`. `exchanged`: pairs of channels that read each other's
    loads throughout; `limits`: where the hunt for what is wrong ended, and why tares are not told; `direct`: the direct
    model, where it was asked for.

    With `tares` the loads and the model are those with the metric part's weight, and the zeros those without any load.
    `stretch` (m,) counts the attitudes of all runs, None where no run states them.
    """

    model: CalibrationModel
    runs: tuple[str, ...]
    run: Index
    loads: Array
    residuals: Array
    left_out: Array
    drift: Drift
    noise: CalibrationNoise
    outliers: tuple[Outlier, ...]
    bad_sequences: tuple[SuspectLoadSeries, ...]
    exchanged: tuple[str, ...] = ()
    limits: tuple[str, ...] = ()
    direct: NonIterativeModel | None = None
    checks: tuple[CheckLoads, ...] = ()
    tares: Tares | None = None
    stretch: Index | None = None

    @property
    def level(self) -> Array:
        """Loads (k,) [N, N m] of the metric part's weight on the level rig, beyond what a zero record knows; or 0."""
        names = self.model.components
        return np.zeros(len(names)) if self.tares is None else self.tares.loads(LEVEL_GRAVITY, names)[0]


def calibrate_all_trims(
    points: CalibrationPoints,
    checks: Sequence[tuple[str, Array, Array]] = (),
    search: bool = True,
    declared: Array | None = None,
    direct: bool = False,
    check_gravity: Mapping[str, Array] | None = None,
) -> AllTrimsCalibration:
    """Fit all points; `checks` are names, readings (m, c) and loads (m, k) of runs that took no part.

    With the `declared` response (c, k) [V per N, N m] channels that are exchanged are named; with `direct` the loads
    are fitted as functions of the readings, too. `check_gravity`: gravity (m, 3) in rig axes of the checks that state
    their attitude, by name.

    Raises least_squares.CollinearError where the loads were never applied by themselves.
    """
    total, found, tares = screen_outliers_with_tares(points, search)
    model = found.fit.model
    k, used = len(model.components), np.asarray(np.isfinite(found.fit.residuals).all(axis=1))
    linear_coefficients = model.coefficients[:k].T
    noise = estimate_calibration_noise(
        found.fit.residuals[used], points.x[used], linear_coefficients, model.residual_covariance
    )
    return AllTrimsCalibration(
        model=model,
        runs=points.run_names,
        run=points.run,
        loads=total.loads,
        residuals=found.fit.residuals,
        left_out=found.fit.left_out,
        drift=drift(model.zeros, found.fit.zero_covariance),
        noise=noise,
        outliers=found.outliers,
        bad_sequences=found.sequences,
        exchanged=() if declared is None else exchanged(points, declared * points.full_range),
        limits=(*found.limits, *_runs_without_attitude(points)),
        direct=fit_noniterative_model(total, model, used, search) if direct else None,
        checks=tuple(
            evaluate_check_loads(model, noise, *check, _tare_loads(tares, model, (check_gravity or {}).get(check[0])))
            for check in checks
        ),
        tares=tares,
        stretch=None if points.gravity is None else points.stretch,
    )


def _tare_loads(tares: Tares | None, model: CalibrationModel, gravity: Array | None) -> Array | None:
    """Loads (m, k) of the metric part's weight; None where they or the attitude are not known."""
    return None if tares is None or gravity is None else tares.loads(gravity, model.components)


def _runs_without_attitude(points: CalibrationPoints) -> Iterator[str]:
    """Runs without attitude among others that have one."""
    if points.gravity is None:
        return
    for run in np.unique(points.run[~np.isfinite(points.gravity).all(axis=1)]):
        yield f"run {points.run_names[run]} does not state its attitude: the weight of the metric part is not told"


def drift(zeros: Array, covariance: Array) -> Drift:
    """A straight line through zeros (s, c) in their order, with the covariance (c, s, s) of each channel's (Aitken).

    NaN for fewer than three sequences.
    """
    s, c = zeros.shape
    if s < MIN_ZEROS:
        return Drift(*(np.full(c, np.nan) for _ in range(3)))
    line = np.column_stack([np.ones(s), np.arange(s) - 0.5 * (s - 1)])
    slope, sigma, scatter = np.zeros(c), np.zeros(c), np.zeros(c)
    for channel in range(c):
        weighted = np.linalg.solve(covariance[channel], np.column_stack([line, zeros[:, channel]]))
        inverse = np.linalg.inv(line.T @ weighted[:, :2])
        found = inverse @ (line.T @ weighted[:, 2])
        left = zeros[:, channel] - line @ found
        slope[channel], sigma[channel] = found[1], np.sqrt(inverse[1, 1])
        scatter[channel] = left @ np.linalg.solve(covariance[channel], left) / (s - 2)
    return Drift(slope, sigma, scatter)


MIN_ZEROS = 3
"""Sequences through whose zeros a line says anything."""


def evaluate_check_loads(
    model: CalibrationModel,
    noise: CalibrationNoise,
    run: str,
    channels: Array,
    loads: Array,
    weight: Array | None = None,
) -> CheckLoads:
    """Loads found from the readings of a run that took no part, counted from the load that it begins with.

    The rows at that load tell its zero: what they read beyond what the model makes of the load. The interval holds the
    noise of the applied load's own reading, where that load was applied. `weight` (m, k): loads of the metric part
    beside those applied.
    """
    weight_loads_in_rows = np.zeros_like(loads) if weight is None else weight
    S = noise.readings
    tare = np.all(np.abs(loads - loads[0]) <= SAME_LOAD_TOLERANCE * model.full_range, axis=1)
    zero = np.mean(channels[tare] - model.readings((loads + weight_loads_in_rows)[tare]), axis=0)
    found, solved = model.loads(channels - zero)
    beyond = (EXTRAPOLATION_MARGIN - 1.0) * model.full_range
    solved &= np.all((found <= model.largest + beyond) & (found >= model.smallest - beyond), axis=1)
    interval = np.full(found.shape, np.nan)
    if solved.any():
        of_readings = model.interval(found[solved], S * (1.0 + 1.0 / np.count_nonzero(tare)))
        applied = np.abs(loads[solved]) > APPLIED_SHARE * model.full_range
        of_load = stats.norm.ppf(0.5 + 0.5 * CONFIDENCE) * applied * noise.loads * model.full_range
        interval[solved] = np.hypot(of_readings, of_load)
    return CheckLoads(run, loads, found - weight_loads_in_rows, interval, solved)


SAME_LOAD_TOLERANCE = 1e-3
"""Of full range: loads that count as the same."""


def read_load_points(run: Run, channel_names: Sequence[str], components: Sequence[str]) -> tuple[Array, Array]:
    """Readings (m, c) and loads (m, k) of a static run."""
    loads = run.read().loads
    assert loads is not None
    return read_channels(run, channel_names), loads[:, [COMPONENTS.index(name) for name in components]]
