"""Static loads of points whose temperature matters: readings referred to the temperature of the calibration."""

from __future__ import annotations

from dataclasses import replace
from itertools import repeat

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import Calibration
from balance_cli.calibration.temperature_terms import UNKNOWN_EFFECT, TemperatureTerms
from balance_cli.reduction.flags import EXTRAPOLATED, NO_TEMPERATURE, SEPARATOR
from balance_cli.steps.point_attitude import without_weight_beside_shaft
from balance_cli.steps.point_loads import PointLoads, point_loads
from balance_cli.steps.point_zeros import PointReadings, ZeroReading

Array = NDArray[np.float64]

ITERATIONS = 4
"""Each reduces the error of the correction by the relative drift of the sensitivity, a few per cent at the most."""


def point_loads_at_temperature(
    readings: PointReadings, calibration: Calibration, zero: ZeroReading | None = None, non_iterative: bool = False
) -> PointLoads:
    """Compute the loads of each row as `point_loads` does, with the effects of temperature taken out of the readings.

    So is what the weight makes a torque meter, or the cells beside its shaft, read otherwise than its hub loads do.

    Where a temperature is not known, sigma contains what those of the calibration would do, and the row is flagged.
    """
    readings, zero = without_weight_beside_shaft(readings, zero, calibration)
    terms = calibration.temperature
    if terms is None:
        result = point_loads(readings, calibration, zero, non_iterative)
        return replace(
            result, flags=tuple(map(_flag, result.flags, repeat(False), _is_far(readings, calibration).tolist()))
        )
    own = readings.temperature
    difference = np.zeros(len(readings.channels)) if own is None else own - terms.reference
    zero_temperature = _zero_temperature(readings, terms, zero)
    zero_difference = (difference.mean() if own is not None else 0.0) if zero_temperature is None else zero_temperature
    if zero is not None:
        shift = dict(zip(terms.channel_names, (zero_difference * terms.coefficients[0]).tolist(), strict=True))
        zero = replace(zero, mean=zero.mean - np.array([shift.get(name, 0.0) for name in zero.channel_names]))
    loads = np.zeros((len(difference), len(terms.components)))
    for _ in range(ITERATIONS):
        result = point_loads(_corrected(readings, terms, difference, loads), calibration, zero, non_iterative)
        loads = np.nan_to_num(result.loads)
    unknown = own is None or zero_temperature is None
    covariance = np.stack(
        [_covariance(terms, row, each, each - zero_difference) for row, each in zip(loads, difference, strict=True)]
    )
    if unknown:
        covariance += _unknown_covariance(terms, loads, own is None)
    corrected = _corrected(readings, terms, difference, loads, covariance)
    result = point_loads(corrected, calibration, zero, non_iterative)
    outside = np.zeros(len(difference), bool) if own is None else np.array([terms.is_outside(each) for each in own])
    return replace(result, flags=tuple(map(_flag, result.flags, [unknown] * len(outside), outside.tolist())))


def _is_far(readings: PointReadings, calibration: Calibration) -> NDArray[np.bool_]:
    """Which rows (n,) are far from the temperatures of a calibration that did not determine what temperature does."""
    if readings.temperature is None or calibration.stated_temperatures is None:
        return np.zeros(len(readings.channels), bool)
    lowest, highest = calibration.stated_temperatures
    return np.maximum(lowest - readings.temperature, readings.temperature - highest) > UNKNOWN_EFFECT


def _zero_temperature(readings: PointReadings, terms: TemperatureTerms, zero: ZeroReading | None) -> float | None:
    """Temperature of the zero less the reference [K]; None where it is not known."""
    if readings.is_zero.any():
        return (
            None
            if readings.temperature is None
            else float(readings.temperature[readings.is_zero].mean()) - terms.reference
        )
    if zero is None:
        return 0.0
    return None if zero.temperature is None else zero.temperature - terms.reference


def _corrected(
    readings: PointReadings, terms: TemperatureTerms, difference: Array, loads: Array, covariance: Array | None = None
) -> PointReadings:
    """The readings at the reference temperature, and the covariance (n, c, c) of the correction."""
    here = [place for place, name in enumerate(terms.channel_names) if name in readings.channel_names]
    at = [readings.channel_names.index(terms.channel_names[place]) for place in here]
    channels = np.array(readings.channels, float)
    channels[:, at] -= difference[:, None] * terms.slopes(loads)[:, here]
    total = None
    if covariance is not None:
        c = len(readings.channel_names)
        total = np.zeros((len(channels), c, c))
        total[np.ix_(range(len(channels)), at, at)] = covariance[np.ix_(range(len(channels)), here, here)]
    return replace(readings, channels=channels, covariance=total)


def _covariance(terms: TemperatureTerms, loads: Array, difference: float, zero_difference: float) -> Array:
    return np.diag(terms.error_variance(zero_difference, difference, loads))


def _unknown_covariance(terms: TemperatureTerms, loads: Array, run_unknown: bool) -> Array:
    """Covariance (n, c, c) of the readings by a zero, and where `run_unknown` rows, whose temperature is not known.

    Rows and zero then differ by two unknown temperatures.
    """
    shift = terms.slopes(np.zeros_like(loads))
    total = shift[:, :, None] * shift[:, None, :]
    if run_unknown:
        drift = terms.slopes(loads, shift=0.0)
        total = 2.0 * total + drift[:, :, None] * drift[:, None, :]
    return np.asarray(terms.spread**2 * total)


def _flag(flag: str, unknown: bool, outside: bool) -> str:
    words = (flag, NO_TEMPERATURE if unknown else "", f"{EXTRAPOLATED} temperature" if outside else "")
    return SEPARATOR.join(word for word in words if word)
