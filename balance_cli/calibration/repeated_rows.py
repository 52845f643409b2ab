"""Repeated rows: consecutive samples at one load, which are one load point and not several.

Whatever else is wrong at a load point (weights, friction, creep) is common to its samples. They are averaged, so that
they do not count as independent rows, and their scatter is kept as pure error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.load_series import MIN_LOAD_CHANGE

Array = NDArray[np.float64]
Index = NDArray[np.intp]

SAME_LOAD_TOLERANCE = 3e-3
"""Share of the calibrated range within which consecutive loads are one: between load noise and the smallest step."""
SAME_READINGS_TOLERANCE = 0.05
"""Share of the largest change of the readings within which those of one load point stay.

Creep, hysteresis and noise are a tenth of it or less; rows that state one load and read another are no repetition, but
one of them has a wrong load.
"""


@dataclass(frozen=True)
class RepeatedRows:
    """Rows (m,) by load point: `first` (m,) is the first row of the load point of each row.

    `channel_scatter` (m, c) [V] and `load_scatter` (m, k) [N, N m]: deviations of the rows from their load point.
    """

    first: Index
    channel_scatter: Array
    load_scatter: Array

    @property
    def is_first(self) -> NDArray[np.bool_]:
        """Whether a row (m,) is the first of its load point, which holds the mean of all its rows."""
        return np.asarray(self.first == np.arange(len(self.first)))

    @property
    def samples(self) -> float:
        """Mean number of rows of a load point."""
        return len(self.first) / int(np.count_nonzero(self.is_first))

    @property
    def dof(self) -> int:
        """Degrees of freedom of the scatter."""
        return len(self.first) - int(np.count_nonzero(self.is_first))

    def noise_covariance(self, C: NDArray[np.floating]) -> Array:
        """Pure-error covariance (c, c) [V2] of the mean of a load point, for the sensitivities C (c, k) [V/N, V/(N m)].

        The load readings vary from sample to sample too; what of it the channels follow is not noise of the channels.
        """
        deviations = self.channel_scatter - self.load_scatter @ C.T
        return np.asarray(deviations.T @ deviations / self.dof / self.samples)


def merge_repeated_rows(
    channels: Array, loads: Array, x: Array, segment: Index
) -> tuple[Array, Array, RepeatedRows | None]:
    """Average consecutive rows at one load: readings (m, c) and loads (m, k), x the loads over their calibrated range.

    The mean stands in the first row of each load point. `segment` (m,) numbers rows that may form one load point: those
    of one run, attitude, load series and kind of point. Two unloaded rows between two load series, where no load is
    sampled repeatedly, are two tare points. Returns readings, loads and the repeated rows, None where there are none.
    """
    change = channels - channels.mean(axis=0)
    size = float(np.max(np.linalg.norm(change, axis=1), initial=0.0))
    first = _first_rows(x, change / size if size > 0 else change, segment)
    if np.all(first == np.arange(len(first))):
        return channels, loads, None
    count = np.bincount(first, minlength=len(first))[first][:, None]
    channel_means, load_means = (_group_sums(values, first) / count for values in (channels, loads))
    scatter = RepeatedRows(first, channels - channel_means, loads - load_means)
    is_first = scatter.is_first[:, None]
    return np.where(is_first, channel_means, channels), np.where(is_first, load_means, loads), scatter


def _group_sums(values: Array, first: Index) -> Array:
    sums = np.zeros_like(values)
    np.add.at(sums, first, values)
    return np.asarray(sums[first])


def _first_rows(x: Array, readings: Array, segment: Index) -> Index:
    """First row (m,) of the load point of each row, for loads and readings relative to their largest."""
    groups = _equal_runs(x, readings, segment)
    base = {int(segment[rows[0]]): x[rows[0]] for rows in reversed(groups)}
    unloaded = [bool(np.all(np.abs(x[rows[0]] - base[int(segment[rows[0]])]) <= MIN_LOAD_CHANGE)) for rows in groups]
    sizes = [len(rows) for rows, is_unloaded in zip(groups, unloaded, strict=True) if not is_unloaded]
    typical = int(np.median(sizes)) if sizes else 1
    first = np.arange(len(x))
    for rows, is_unloaded in zip(groups, unloaded, strict=True):
        for part in _load_points(rows, is_unloaded, typical):
            first[part] = part[0]
    return first


def _load_points(rows: Index, is_unloaded: bool, typical: int) -> list[Index]:
    """Load points among rows at one load: unloaded rows may close one load series and open the next."""
    if not is_unloaded:
        return [rows]
    if typical < 2:
        return np.split(rows, len(rows))
    return [rows] if len(rows) < 2 * typical else [rows[: len(rows) - typical], rows[len(rows) - typical :]]


def _equal_runs(x: Array, readings: Array, segment: Index) -> list[Index]:
    """Consecutive rows of one segment whose loads and readings equal those of the first of them."""
    groups: list[list[int]] = []
    for row in range(len(x)):
        start = groups[-1][0] if groups else -1
        same = bool(groups) and segment[row] == segment[start]
        same = same and bool(np.all(np.abs(x[row] - x[start]) <= SAME_LOAD_TOLERANCE))
        if same and np.linalg.norm(readings[row] - readings[start]) <= SAME_READINGS_TOLERANCE:
            groups[-1].append(row)
        else:
            groups.append([row])
    return [np.array(rows, np.intp) for rows in groups]
