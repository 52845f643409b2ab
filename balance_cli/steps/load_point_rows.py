"""Load points of a static run: which rows enter a fit, and what they read.

Every fit of a calibration uses the same rows: the matrices of each trim and the model of all trims.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.repeated_rows import RepeatedRows, merge_repeated_rows
from balance_cli.campaign.recording.run import MemorySource, Run, read_channels
from balance_cli.campaign.rig.attitude import attitude_segments, gravity_directions
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.io.errors import UserError
from balance_cli.signals.static_noise import static_points

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

MIN_NOISE_DOF = 10.0
"""Degrees of freedom from which a noise covariance is known: its standard deviations then are to some 20 %."""
MIN_NOISE_DOF_PER_CHANNEL = 2.0
"""Degrees of freedom for each channel: with fewer the inverse of the covariance is biased by a factor above two."""


@dataclass(frozen=True)
class LoadPointRows:
    """The rows of a static run; those of one load point hold their mean in the first of them.

    `run`: the run with these readings and loads. `used` (n,): rows that enter the fits: the first of each load point
    that is not a check point. `is_check` (n,): check points, the first row of each. `repeats`: what was averaged, for
    all channels and six loads. `load_series` (n,): number of the load series, None until it is known.
    """

    run: Run
    used: Mask
    is_check: Mask
    repeats: RepeatedRows | None
    load_series: Index | None = None

    @property
    def loads(self) -> Array:
        """Loads (n, 6) [N, N m]."""
        loads = self.run.read().loads
        assert loads is not None
        return loads

    @property
    def stated_series(self) -> tuple[str, ...]:
        """Label of the load series of each row, empty where the run states none."""
        return self.run.series_labels or ("",) * self.run.samples

    @property
    def tare_points(self) -> Mask:
        """Rows (n,) that are stated to be tare points."""
        return np.array([kind == "tare" for kind in self.run.point_kinds or ("",) * self.run.samples], bool)

    def exclude_rows(self, excluded: Mask, load_series: Index) -> LoadPointRows:
        """Copy without some rows (n,), with known load series (n,)."""
        return replace(self, used=self.used & ~excluded, load_series=load_series)


def load_point_rows(runs: Sequence[Run]) -> tuple[LoadPointRows, ...]:
    """Average the repeated rows of static runs, and set the check points apart."""
    blocks = [run.read() for run in runs]
    size = np.zeros(len(COMPONENTS))
    for block in blocks:
        assert block.loads is not None
        size = np.maximum(size, np.abs(block.loads).max(axis=0, initial=0.0))
    scale = np.where(size > 0, size, 1.0)
    return tuple(
        _rows_of_run(run, block.channels, np.asarray(block.loads, float), scale)
        for run, block in zip(runs, blocks, strict=True)
    )


def _rows_of_run(run: Run, channels: Array, loads: Array, scale: Array) -> LoadPointRows:
    is_check = np.array([kind == "check" for kind in run.point_kinds or ("",) * run.samples], bool)
    merged_channels, merged_loads, repeats = merge_repeated_rows(
        channels, loads, loads / scale, _repeatable_segments(run, is_check)
    )
    is_first = np.ones(run.samples, bool) if repeats is None else repeats.is_first
    merged = run if repeats is None else replace(run, source=MemorySource(merged_channels, merged_loads))
    return LoadPointRows(merged, is_first & ~is_check, is_first & is_check, repeats)


def _repeatable_segments(run: Run, is_check: Mask) -> Index:
    """Number (n,) of consecutive rows of one attitude, load series and kind."""
    gravity = None if run.attitude is None else gravity_directions(run.attitude)
    attitude = attitude_segments(np.zeros(run.samples, np.intp), gravity)
    labels = np.unique(run.series_labels or ("",) * run.samples, return_inverse=True)[1]
    keys = np.column_stack([attitude, labels, is_check])
    return np.asarray(np.cumsum(np.any(np.diff(keys, axis=0, prepend=keys[:1]) != 0, axis=1)), np.intp)


@dataclass(frozen=True)
class RowNoise:
    """Noise of a row: covariance (c, c) [V2], degrees of freedom (0 if unknown), and relative variance of each run."""

    covariance: Array
    dof: float
    relative: Array


def measure_row_noise(rows: Sequence[LoadPointRows], channel_names: Sequence[str]) -> RowNoise:
    """Noise of the rows of several runs, pooled: the scatter of repeated rows, or differences along the ramps.

    Unknown where a run has neither, or all together have too few degrees of freedom.
    """
    c = len(channel_names)
    unknown = RowNoise(np.zeros((c, c)), 0.0, np.ones(len(rows)))
    measured = [_noise_of_run(each, channel_names) for each in rows]
    known = [(covariance, dof) for covariance, dof in measured if dof > 0]
    dof = sum(dof for _, dof in known)
    if len(known) < len(measured) or dof < max(MIN_NOISE_DOF, MIN_NOISE_DOF_PER_CHANNEL * (c + 1)):
        return unknown
    pooled = np.asarray(sum(covariance * each for covariance, each in known) / dof)
    if np.any(np.diagonal(pooled) <= 0.0):
        return unknown
    relative = [float(np.mean(np.diagonal(covariance) / np.diagonal(pooled))) for covariance, _ in known]
    return RowNoise(pooled, dof, np.array(relative))


def repeat_scatter(rows: Sequence[LoadPointRows], channel_names: Sequence[str]) -> Array | None:
    """What the covariance (c, c) [V2] of one reading exceeds that of a load point by, which is a mean of readings.

    Pooled over the runs with repeated rows; None without any.
    """
    parts = []
    for each in rows:
        if each.repeats is not None and each.repeats.dof > 0:
            of_mean, dof = _noise_of_repeats(each, each.repeats, channel_names)
            parts.append((of_mean * (each.repeats.samples - 1.0), dof))
    return np.asarray(sum(part * dof for part, dof in parts) / sum(dof for _, dof in parts)) if parts else None


def _noise_of_run(rows: LoadPointRows, channel_names: Sequence[str]) -> tuple[Array, float]:
    """Noise covariance (c, c) [V2] of a row of a run, and its degrees of freedom, 0 where it is not known."""
    c = len(channel_names)
    if rows.repeats is not None:
        return _noise_of_repeats(rows, rows.repeats, channel_names)
    try:
        points = static_points(rows.run, channel_names)
    except UserError:  # too few rows in a ramp
        return np.zeros((c, c)), 0.0
    return points.covariance, points.dof


def _noise_of_repeats(rows: LoadPointRows, repeats: RepeatedRows, channel_names: Sequence[str]) -> tuple[Array, float]:
    at = [rows.run.channel_names.index(name) for name in channel_names]
    X = np.column_stack([np.ones(rows.run.samples), rows.loads])
    C = np.linalg.lstsq(X, read_channels(rows.run, channel_names), rcond=None)[0][1:].T
    return replace(repeats, channel_scatter=repeats.channel_scatter[:, at]).noise_covariance(C), float(repeats.dof)
