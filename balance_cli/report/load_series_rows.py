"""Rows of a gage calibration as its pictures need them: loading sequences, what moved in them, what took no part."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.all_trims import AllTrimsCalibration
from balance_cli.calibration.load_series import MIN_LOAD_CHANGE, describe_load_series, find_load_series
from balance_cli.calibration.outliers import Outlier
from balance_cli.calibration.result import Calibration

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class LoadSeriesRows:
    """One loading sequence: its rows among those of all runs, its run, the loads that moved (by number), its name.

    `bad` (c,): channels in which it is bad; `used`: whether any row of it took part in the fit.
    """

    rows: Index
    run: int
    moved: tuple[int, ...]
    words: str
    bad: NDArray[np.bool_]
    used: bool

    @property
    def ends(self) -> tuple[float, float]:
        """Its ends in the order of loading, rows counted from 1."""
        return float(self.rows[0]) + 0.5, float(self.rows[-1]) + 1.5


def split_load_series(gage: AllTrimsCalibration) -> tuple[LoadSeriesRows, ...]:
    """All loading sequences in their order, those that took no part included."""
    x = gage.loads / gage.model.full_range
    sequence = find_load_series(x, gage.run if gage.stretch is None else gage.stretch)
    return tuple(_load_series_rows(gage, x, np.flatnonzero(sequence == name)) for name in np.unique(sequence))


def _load_series_rows(gage: AllTrimsCalibration, x: Array, rows: Index) -> LoadSeriesRows:
    run = int(gage.run[rows[0]])
    of_run = np.flatnonzero(gage.run == run)
    words = describe_load_series(rows - of_run[0], gage.runs[run], gage.model.components, x[of_run])
    wrong = {one.channel for one in gage.bad_sequences if one.sequence == words}
    return LoadSeriesRows(
        rows=rows,
        run=run,
        moved=tuple(np.flatnonzero(np.ptp(x[rows], axis=0) > MIN_LOAD_CHANGE).tolist()),
        words=words,
        bad=np.array([name in wrong for name in gage.model.channel_names]),
        used=bool(np.isfinite(gage.residuals[rows]).any()),
    )


def channel_outliers(gage: AllTrimsCalibration, channel: int) -> Iterator[tuple[int, Outlier]]:
    """(row among those of all runs, outlier) of one channel."""
    for one in gage.outliers:
        if one.channel == gage.model.channel_names[channel]:
            first = int(np.flatnonzero(gage.run == gage.runs.index(one.run))[0])
            yield first + one.row - 1, one


def channel_residual_sigma(gage: AllTrimsCalibration) -> Array:
    """Residual standard deviation (c,) of a row [V]."""
    return np.asarray(np.sqrt(np.diag(gage.model.residual_covariance)))


def channel_ranges(calibration: Calibration, gage: AllTrimsCalibration) -> Array:
    """Full range (c,) of the gage model's channels [V]."""
    trim = next(iter(calibration.trims.values()))
    known = dict(zip(trim.channel_names, trim.channel_full_range.tolist(), strict=True))
    return np.array([known[name] for name in gage.model.channel_names])
