"""The weight of the metric part in the attitude of each point: what it adds to the loads, and where it is not known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.all_trims_result import LEVEL_GRAVITY
from balance_cli.calibration.result import Calibration
from balance_cli.campaign.rig.attitude import is_one_direction
from balance_cli.steps.point_zeros import PointReadings, ZeroReading

Array = NDArray[np.float64]


def weight_of_metric_part(calibration: Calibration, gravity: Array | None) -> Array:
    """Loads (n, k) [N, N m] of the weight in the directions of gravity (n, 3), of the level rig (k,) without them.

    Zero where the calibration did not determine the weight.
    """
    all_trims = calibration.all_trims
    if all_trims is None or all_trims.tares is None:
        return np.zeros(())
    if gravity is None:
        return all_trims.level_weight_loads
    return all_trims.tares.loads(gravity, all_trims.model.components)


def without_weight_beside_shaft(
    readings: PointReadings, zero: ZeroReading | None, calibration: Calibration
) -> tuple[PointReadings, ZeroReading | None]:
    """Readings and zero less what the weight makes the channels read beyond its hub loads, beside a shaft."""
    all_trims = calibration.all_trims
    if all_trims is None or all_trims.tares is None or all_trims.tares.beside_shaft is None:
        return readings, zero
    own = all_trims.readings_beside_shaft(readings.gravity, readings.channel_names)
    if zero is not None:
        gravity = None if zero.gravity is None else zero.gravity[None]
        zero = replace(zero, mean=zero.mean - all_trims.readings_beside_shaft(gravity, zero.channel_names)[0])
    return replace(readings, channels=readings.channels - own), zero


def weight_covariance(readings: PointReadings, calibration: Calibration, zero: ZeroReading | None) -> Array:
    """Covariance (n, k, k) of the loads by the error of the weight, between the attitudes of each row and its zero."""
    all_trims = calibration.all_trims
    if all_trims is None or all_trims.tares is None or readings.gravity is None:
        return np.zeros(())
    of_zero = _gravity_of_zero(readings, zero, LEVEL_GRAVITY)
    return all_trims.tares.difference_covariance(readings.gravity, of_zero, all_trims.model.components)


def rows_of_unknown_weight(
    readings: PointReadings, calibration: Calibration, zero: ZeroReading | None
) -> NDArray[np.bool_]:
    """Rows (n,) whose weight is not known: in another attitude than their zero, or in none that is stated.

    The former where the calibration did not determine the weight; without an unloaded row or record the zero has the
    attitude of the first row. The latter are all rows without an attitude where it did: they count as level.
    """
    gravity, all_trims = readings.gravity, calibration.all_trims
    if all_trims is not None and all_trims.tares is not None:
        return np.full(len(readings.channels), gravity is None)
    if gravity is None:
        return np.zeros(len(readings.channels), bool)
    pairs = zip(gravity, _gravity_of_zero(readings, zero, gravity[:1]), strict=True)
    return np.array([not is_one_direction(np.vstack(pair)) for pair in pairs])


def _gravity_of_zero(readings: PointReadings, zero: ZeroReading | None, otherwise: Array) -> Array:
    """Direction of gravity (n, 3) of the zero of each row, the mean of its unloaded rows; `otherwise` if not known."""
    gravity = readings.gravity
    assert gravity is not None
    directions = np.tile(otherwise if zero is None or zero.gravity is None else zero.gravity, (len(gravity), 1))
    for number in np.unique(readings.zero_group) if readings.is_zero.any() else ():
        members = readings.zero_group == number
        own = readings.is_zero & members
        directions[members] = gravity[own if own.any() else readings.is_zero].mean(axis=0)
    return directions
