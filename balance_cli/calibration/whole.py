"""The whole calibration, all trims together: gage model, zeros, what is wrong in it, and loads that checked it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from balance_cli.calibration.fit import LoadPoints
from balance_cli.calibration.gage_model import CONFIDENCE, GageModel
from balance_cli.calibration.noise import APPLIED, NoiseParts, noise_parts
from balance_cli.calibration.suspects import BadSequence, Outlier, examined
from balance_cli.components import COMPONENTS
from balance_cli.runs import Run, read_channels

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class Drift:
    """Zeros over the order of the sequences: slope (c,) [V per sequence] with sigma, and how much more the zeros

    scatter about that line than their standard errors say, as chi-square per degree of freedom (c,).
    """

    slope: Array
    slope_sigma: Array
    scatter: Array


@dataclass(frozen=True)
class CheckedLoads:
    """Loads that took no part: applied (m, k) and found (m, k) [N, N m], half the prediction interval (m, k).

    `solved` (m,): rows within the range of the calibration, where the iteration holds.
    """

    run: str
    applied: Array
    found: Array
    interval: Array
    solved: NDArray[np.bool_]

    @property
    def hits(self) -> Array:
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
class GageCalibration:
    """Gage model of all trims with the rows behind it: loads (m, k), residuals and errors of sequences left out (m, c)

    [V], NaN where a row took no part; `run` (m,) counts `runs`.
    """

    model: GageModel
    runs: tuple[str, ...]
    run: Index
    loads: Array
    residuals: Array
    left_out: Array
    drift: Drift
    noise: NoiseParts
    outliers: tuple[Outlier, ...]
    bad_sequences: tuple[BadSequence, ...]
    checks: tuple[CheckedLoads, ...] = ()


def gage_calibration(
    points: LoadPoints, checks: Sequence[tuple[str, Array, Array]] = (), search: bool = True
) -> GageCalibration:
    """Fit all points; `checks` are names, readings (m, c) and loads (m, k) of runs that took no part.

    Raises least_squares.Collinear where the loads were never applied by themselves.
    """
    found = examined(points, search)
    model = found.fit.model
    k, used = len(model.components), np.isfinite(found.fit.residuals).all(axis=1)
    straight = model.coefficients[:k].T
    noise = noise_parts(found.fit.residuals[used], points.x[used], straight, model.residual_covariance)
    return GageCalibration(
        model=model,
        runs=points.run_names,
        run=points.run,
        loads=points.loads,
        residuals=found.fit.residuals,
        left_out=found.fit.left_out,
        drift=drift(model.zeros, model.zero_sigma),
        noise=noise,
        outliers=found.outliers,
        bad_sequences=found.sequences,
        checks=tuple(checked(model, noise, *check) for check in checks),
    )


def drift(zeros: Array, sigma: Array) -> Drift:
    """A straight line through zeros (s, c) with standard errors (s, c), channel by channel."""
    n = np.arange(len(zeros), dtype=float)
    weight = 1.0 / np.maximum(sigma, np.finfo(float).tiny) ** 2
    total = weight.sum(axis=0)
    centred = n[:, None] - (weight * n[:, None]).sum(axis=0) / total
    moment = np.maximum(np.sum(weight * centred**2, axis=0), np.finfo(float).tiny)
    slope = np.sum(weight * centred * zeros, axis=0) / moment
    middle = np.sum(weight * zeros, axis=0) / total
    left = zeros - middle - slope * centred
    scatter = np.sum(weight * left**2, axis=0) / max(len(zeros) - 2, 1)
    return Drift(slope, 1.0 / np.sqrt(moment), scatter)


def checked(model: GageModel, noise: NoiseParts, run: str, channels: Array, loads: Array) -> CheckedLoads:
    """Loads found from the readings of a run that took no part, counted from the load that it begins with.

    The rows at that load tell its zero: what they read beyond what the model makes of the load. The interval holds the
    noise of the applied load's own reading, where that load was applied.
    """
    S = noise.readings
    tare = np.all(np.abs(loads - loads[0]) <= SAME_LOAD * model.full_range, axis=1)
    zero = np.mean(channels[tare] - model.readings(loads[tare]), axis=0)
    found, solved = model.loads(channels - zero)
    interval = np.full(found.shape, np.nan)
    if solved.any():
        of_readings = model.interval(found[solved], S * (1.0 + 1.0 / np.count_nonzero(tare)))
        applied = np.abs(loads[solved]) > APPLIED * model.full_range
        of_load = stats.norm.ppf(0.5 + 0.5 * CONFIDENCE) * applied * noise.loads * model.full_range
        interval[solved] = np.hypot(of_readings, of_load)
    return CheckedLoads(run, loads, found, interval, solved)


SAME_LOAD = 1e-3
"""Of full range: loads that count as the same."""


def rows_of(run: Run, channel_names: Sequence[str], components: Sequence[str]) -> tuple[Array, Array]:
    """Readings (m, c) and loads (m, k) of a static run."""
    loads = run.read().loads
    assert loads is not None
    return read_channels(run, channel_names), loads[:, [COMPONENTS.index(name) for name in components]]
