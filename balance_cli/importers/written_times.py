"""Rate of times that were written with few significant digits, as spreadsheets do: `9.98E-02`, `1.00E-01`, `1.00E-01`.

Late times then stand for several samples each, and a straight line through them is off by up to half a step: halves are
rounded upward. What is known is that each time lies within half a unit of its last digit. The roundest rate for which
all do is the rate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from balance_cli.importers.base import Array, ReadBlock

BLOCK = 2**17
FEWEST_DIGITS, MOST_DIGITS = 2, 6
"""Significant digits; more of them are no coarse rounding."""
ROUNDING = 1e-6
"""Of a unit of the last digit: decimal numbers are no binary ones."""
DOUBLE_PRECISION = 1e-9
"""Of a unit of the last digit: a number of MOST_DIGITS digits has an error of 1e-10 of it in double precision. Seconds
from 1970 are within 1e-6 of a multiple of ten million for ten seconds, and times of day have six digits to 0.2."""
ROUND_RATES = tuple(m * 10.0**e for e in range(4, -4, -1) for m in (5.0, 2.0, 1.0))
"""[1/unit of the times] of which a rate may be a multiple, the roundest first."""
LARGEST_CORRECTION = 0.01
"""Relative difference from the rate of a straight line at most: a short record of three digits is off by 0.2 %."""


@dataclass(frozen=True)
class WrittenTimes:
    """The `rate` and the `start` that agree with all times within the last digit that was written."""

    rate: float
    start: float


def read_written_times(read: ReadBlock, samples: int, rate: float, factor: float) -> WrittenTimes | None:
    """The roundest rate near `rate` [Hz] with which all times agree; None where they have more digits, or with none.

    `factor` makes seconds of the times in column 0.
    """
    digits = _significant_digits(read, samples)
    if digits is None:
        return None
    tried_rates = []
    for unit in ROUND_RATES:
        candidate = round(rate / unit) * unit
        if candidate <= 0.0 or abs(candidate / rate - 1.0) > LARGEST_CORRECTION or candidate in tried_rates:
            continue
        tried_rates.append(candidate)
        start = _common_start(read, samples, 1.0 / (candidate * factor), digits)
        if start is not None:
            return WrittenTimes(candidate, start * factor)
    return None


def _common_start(read: ReadBlock, samples: int, step: float, digits: int) -> float | None:
    """The start from which equal steps pass each time within half a unit of its last digit; None where none does."""
    least, most = -np.inf, np.inf
    for start in range(0, samples, BLOCK):
        times = read([0], start, min(start + BLOCK, samples))[:, 0]
        begin, half = times - step * np.arange(start, start + len(times)), 0.5 * _last_digit(times, digits)
        half = half * (1.0 + ROUNDING) + ROUNDING * step
        least, most = max(least, float(np.max(begin - half))), min(most, float(np.min(begin + half)))
        if least > most:
            return None
    return 0.5 * (least + most)


def _significant_digits(read: ReadBlock, samples: int) -> int | None:
    """Significant digits with which all times were written; None where these are more than MOST_DIGITS."""
    digits = FEWEST_DIGITS
    for start in range(0, samples, BLOCK):
        times = read([0], start, min(start + BLOCK, samples))[:, 0]
        while not _has_digits(times, digits):
            digits += 1
            if digits > MOST_DIGITS:
                return None
    return digits


def _has_digits(times: Array, digits: int) -> bool:
    ratio = times / _last_digit(times, digits)
    return bool(np.all(np.abs(ratio - np.round(ratio)) < DOUBLE_PRECISION))


def _last_digit(times: Array, digits: int) -> Array:
    """Value of one in the last significant digit of each time, for this number of digits; a time of 0 is exact."""
    size = np.abs(times)
    exponent = np.floor(np.log10(np.where(size > 0.0, size, 1.0)) + 1e-9)
    return np.asarray(np.where(size > 0.0, 10.0 ** (exponent - digits + 1), 1e-12))
