"""Readings of points less those of the unloaded balance: which zero belongs to which row."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.trim_model import WITHOUT_ZEROS
from balance_cli.io.errors import UserError
from balance_cli.signals import distributions

Array = NDArray[np.float64]
Index = NDArray[np.intp]

CALIBRATION_ZERO = "mean of the calibration"
"""The zero, in words, where no row or record of the unloaded balance is known."""
MOVEMENT_CONFIDENCE = 0.999
"""Confidence at which the zeros of a group differ by more than their noise."""


@dataclass(frozen=True)
class PointReadings:
    """Rows of one run to be reduced: `channels` (n, c) of `channel_names`, in the base units of the geometry.

    `zero_group` (n,): number of the group of rows that share a zero; `is_zero` (n,): rows of the unloaded balance.
    `load_series` (n,): number of the load series of each row, where a group may have several; None where it has one.
    `applied` (n, k): loads that are known, of the components of the calibration; None where the table has none.
    `temperature` (n,) [degC], `gravity` (n, 3) in rig axes; None where they are not known.
    `covariance` (n, c, c): of what was taken off the readings.
    """

    run: str
    channel_names: tuple[str, ...]
    channels: Array
    zero_group: Index
    is_zero: NDArray[np.bool_]
    applied: Array | None = None
    temperature: Array | None = None
    covariance: Array | None = None
    load_series: Index | None = None
    gravity: Array | None = None


@dataclass(frozen=True)
class SubtractedZero:
    """What was subtracted from each row: `variance` (n,) of its noise, in units of that of a reading, and `words`.

    `scatter` (n,): how many times the variance of the zeros between load series comes beside it, as it is the zero of
    another series: 1 for a mean of many.
    """

    variance: Array
    scatter: Array
    words: str


@dataclass(frozen=True)
class ZeroReading:
    """Reading (c,) of the unloaded balance, the mean of `rows` rows.

    Its mean `temperature` [degC] and its direction of `gravity` (3,) in rig axes; None where they are not known.
    """

    channel_names: tuple[str, ...]
    mean: Array
    rows: int
    temperature: float | None = None
    gravity: Array | None = None


def change_from_zero(
    readings: PointReadings,
    model: CalibrationModel,
    rows: Index,
    weight: Callable[[Array | None], Array],
    zero: ZeroReading | None,
) -> tuple[Array, SubtractedZero]:
    """Readings (n, c) less the zero, and what that zero is.

    `rows`: the channels of the model that the readings have; `weight`: loads (n, k) of the metric part for directions
    of gravity (n, 3). Raises UserError where the zero lacks a channel, or there is none.
    """
    names = [model.channel_names[i] for i in rows]
    values = readings.channels[:, [readings.channel_names.index(name) for name in names]]
    n = len(values)
    if readings.is_zero.any():
        unloaded = values - _tare_loads_reading(readings, model, weight(readings.gravity))[:, rows]
        zeros, counts = _zeros_by_group(unloaded, readings.zero_group, readings.is_zero)
        noise = np.diag(model.residual_covariance)[rows]
        moved = _movement_by_group(unloaded, readings.zero_group, readings.is_zero, noise)
        zero_of = SubtractedZero(1.0 / counts + moved, _scatter_share(readings), "rows of the unloaded balance")
        return values - zeros, zero_of
    if zero is not None:
        missing = [name for name in names if name not in zero.channel_names]
        if missing:
            fault = f"the zero has no channel {', '.join(missing)}"
            raise UserError(fault, "--zero", remedy="Give a zero with all channels of the table")
        mean = zero.mean[[zero.channel_names.index(name) for name in names]]
        own_weight = np.zeros((1, len(model.components))) + weight(None if zero.gravity is None else zero.gravity[None])
        own = model.readings(own_weight)[:, rows]
        # The zero of another load series, whose own differs by what the zeros of two of them do.
        return values - mean + own, SubtractedZero(np.full(n, 1.0 / zero.rows), np.full(n, 2.0), "zero record")
    if model.load_series == (WITHOUT_ZEROS,):
        fault = "the calibration is a matrix without zeros, and no row is marked as that of the unloaded balance"
        raise UserError(
            fault, readings.run, "--zero", "Give `--zero first`, a table of unloaded rows, or a column `point`"
        )
    return values - model.zeros.mean(axis=0)[rows], SubtractedZero(np.zeros(n), np.ones(n), CALIBRATION_ZERO)


def _scatter_share(readings: PointReadings) -> Array:
    """Variance (n,) of the zero of a row's series less that subtracted, over that of the zeros between load series."""
    series = readings.zero_group if readings.load_series is None else readings.load_series
    share = np.zeros(len(series))
    for number in np.unique(readings.zero_group).tolist():
        members = readings.zero_group == number
        own = readings.is_zero & members
        with_zero = np.unique(series[own if own.any() else readings.is_zero])
        share[members & ~np.isin(series, with_zero)] = 1.0 + 1.0 / len(with_zero)
    return share


def _tare_loads_reading(readings: PointReadings, model: CalibrationModel, weight: Array) -> Array:
    """Readings (n, c) that known loads and the weight of the metric part cause."""
    known = np.zeros((len(readings.channels), len(model.components)))
    known = known if readings.applied is None else readings.applied
    return model.readings(known + weight)


def _zeros_by_group(unloaded: Array, group: Index, is_zero: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Zero (n, c) of each row, the mean over its group or, where that has none, over all; and number of rows (n,)."""
    zeros = np.tile(unloaded[is_zero].mean(axis=0), (len(unloaded), 1))
    counts = np.full(len(unloaded), float(np.count_nonzero(is_zero)))
    for number in np.unique(group[is_zero]):
        members = group == number
        zeros[members] = unloaded[members & is_zero].mean(axis=0)
        counts[members] = np.count_nonzero(members & is_zero)
    return zeros, counts


def _movement_by_group(unloaded: Array, group: Index, is_zero: NDArray[np.bool_], noise: Array) -> Array:
    """Variance (n,) of the zeros of each row's group about their mean, over the `noise` (c,) of a reading.

    It is that of a zero which drifts or jumps within the group, at a row in between; nothing where noise explains it.
    """
    moved = np.zeros(len(unloaded))
    for number in np.unique(group).tolist():
        members = group == number
        own = members & is_zero if (members & is_zero).any() else is_zero
        dof = (np.count_nonzero(own) - 1) * unloaded.shape[1]
        if dof <= 0 or not np.all(noise > 0.0):
            continue
        ratio = float(np.sum((unloaded[own] - unloaded[own].mean(axis=0)) ** 2 / noise)) / dof
        if ratio * dof > distributions.chi2.ppf(MOVEMENT_CONFIDENCE, dof):
            moved[members] = ratio
    return moved
