"""Readings of points less those of the unloaded balance: which zero belongs to which row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.trim_model import WITHOUT_ZEROS
from balance_cli.io.errors import UserError

Array = NDArray[np.float64]
Index = NDArray[np.intp]

CALIBRATION_ZERO = "mean of the calibration"
"""The zero, in words, where no row or record of the unloaded balance is known."""


@dataclass(frozen=True)
class PointReadings:
    """Rows of one run to be reduced: `channels` (n, c) of `channel_names`, in the base units of the geometry.

    `zero_group` (n,): number of the group of rows that share a zero; `is_zero` (n,): rows of the unloaded balance.
    `applied` (n, k): loads that are known, of the components of the calibration; None where the table has none.
    `temperature` (n,) [degC]; None where it is not known. `covariance` (n, c, c): of what was taken off the readings.
    """

    run: str
    channel_names: tuple[str, ...]
    channels: Array
    zero_group: Index
    is_zero: NDArray[np.bool_]
    applied: Array | None = None
    temperature: Array | None = None
    covariance: Array | None = None


@dataclass(frozen=True)
class ZeroReading:
    """Reading (c,) of the unloaded balance, the mean of `rows` rows; its mean `temperature` [degC], None if unknown."""

    channel_names: tuple[str, ...]
    mean: Array
    rows: int
    temperature: float | None = None


def change_from_zero(
    readings: PointReadings, model: CalibrationModel, rows: Index, level: Array, zero: ZeroReading | None
) -> tuple[Array, Array, str]:
    """Readings (n, c) less the zero, variance (n,) of the zero in units of a reading's, and the zero in words.

    `rows`: the channels of the model that the readings have; `level` (k,): loads of the weight of the metric part.
    Raises UserError where the zero lacks a channel, or there is none.
    """
    names = [model.channel_names[i] for i in rows]
    values = readings.channels[:, [readings.channel_names.index(name) for name in names]]
    if readings.is_zero.any():
        unloaded = values - _tare_loads_reading(readings, model, level)[:, rows]
        zeros, counts = _zeros_by_group(unloaded, readings.zero_group, readings.is_zero)
        return values - zeros, 1.0 / counts, "rows of the unloaded balance"
    if zero is not None:
        missing = [name for name in names if name not in zero.channel_names]
        if missing:
            fault = f"the zero has no channel {', '.join(missing)}"
            raise UserError(fault, "--zero", remedy="Give a zero with all channels of the table")
        mean = zero.mean[[zero.channel_names.index(name) for name in names]]
        return values - mean, np.full(len(values), 1.0 / zero.rows), "zero record"
    if model.load_series == (WITHOUT_ZEROS,):
        fault = "the calibration is a matrix without zeros, and no row is marked as that of the unloaded balance"
        raise UserError(
            fault, readings.run, "--zero", "Give `--zero first`, a table of unloaded rows, or a column `point`"
        )
    return values - model.zeros.mean(axis=0)[rows], np.zeros(len(values)), CALIBRATION_ZERO


def _tare_loads_reading(readings: PointReadings, model: CalibrationModel, level: Array) -> Array:
    """Readings (n, c) that known loads and the weight of the metric part cause."""
    known = np.zeros((len(readings.channels), len(model.components)))
    known = known if readings.applied is None else readings.applied
    return model.readings(known + level)


def _zeros_by_group(unloaded: Array, group: Index, is_zero: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Zero (n, c) of each row, the mean over its group or, where that has none, over all; and number of rows (n,)."""
    zeros = np.tile(unloaded[is_zero].mean(axis=0), (len(unloaded), 1))
    counts = np.full(len(unloaded), float(np.count_nonzero(is_zero)))
    for number in np.unique(group[is_zero]):
        members = group == number
        zeros[members] = unloaded[members & is_zero].mean(axis=0)
        counts[members] = np.count_nonzero(members & is_zero)
    return zeros, counts
