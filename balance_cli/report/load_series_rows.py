"""Load series of a calibration for its pictures: rows, varied loads, excluded rows and suspect channels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.all_trims_result import AllTrimsCalibration, Outlier
from balance_cli.calibration.load_series import MIN_LOAD_CHANGE, describe_load_series, find_load_series
from balance_cli.calibration.result import Calibration

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class LoadSeriesRows:
    """One load series: `rows` among those of all runs, index of its run, indices of the varied loads, description.

    `bad` (c,): channels that are suspect in it; `used`: whether the fit includes any of its rows.
    """

    rows: Index
    run: int
    moved: tuple[int, ...]
    words: str
    bad: NDArray[np.bool_]
    used: bool

    @property
    def ends(self) -> tuple[float, float]:
        """Limits on the axis of the order of loading, rows counted from 1."""
        return float(self.rows[0]) + 0.5, float(self.rows[-1]) + 1.5


def split_load_series(all_trims: AllTrimsCalibration) -> tuple[LoadSeriesRows, ...]:
    """Split all rows into their load series, in order, including excluded ones."""
    x = all_trims.loads / all_trims.model.calibrated_range
    load_series = all_trims.load_series
    if load_series is None:
        load_series = find_load_series(
            x, all_trims.run if all_trims.attitude_segment is None else all_trims.attitude_segment
        )
    return tuple(
        _load_series_rows(all_trims, x, np.flatnonzero(load_series == name)) for name in np.unique(load_series)
    )


def _load_series_rows(all_trims: AllTrimsCalibration, x: Array, rows: Index) -> LoadSeriesRows:
    run = int(all_trims.run[rows[0]])
    run_rows = np.flatnonzero(all_trims.run == run)
    words = describe_load_series(rows - run_rows[0], all_trims.runs[run], all_trims.model.components, x[run_rows])
    suspect_channels = {suspect.channel for suspect in all_trims.suspect_series if suspect.load_series == words}
    return LoadSeriesRows(
        rows=rows,
        run=run,
        moved=tuple(np.flatnonzero(np.ptp(x[rows], axis=0) > MIN_LOAD_CHANGE).tolist()),
        words=words,
        bad=np.array([name in suspect_channels for name in all_trims.model.channel_names]),
        used=bool(np.isfinite(all_trims.residuals[rows]).any()),
    )


def channel_outliers(all_trims: AllTrimsCalibration, channel: int) -> Iterator[tuple[int, Outlier]]:
    """Pairs of row, among those of all runs, and outlier of one channel."""
    for outlier in all_trims.outliers:
        if outlier.channel == all_trims.model.channel_names[channel]:
            first = int(np.flatnonzero(all_trims.run == all_trims.runs.index(outlier.run))[0])
            yield first + outlier.row - 1, outlier


def channel_residual_sigma(all_trims: AllTrimsCalibration) -> Array:
    """Residual standard deviation (c,) of a row [V]."""
    return np.asarray(np.sqrt(np.diag(all_trims.model.residual_covariance)))


def channel_ranges(calibration: Calibration, all_trims: AllTrimsCalibration) -> Array:
    """Rated range (c,) [V] of the channels of the calibration model."""
    trim = next(iter(calibration.trims.values()))
    ranges = dict(zip(trim.channel_names, trim.channel_rated_range.tolist(), strict=True))
    return np.array([ranges[name] for name in all_trims.model.channel_names])
