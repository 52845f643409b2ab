"""Sample rates from steps that were written with few digits."""

from __future__ import annotations

import math
import re

LARGEST_WIDTH = 1e-4
"""Relative rounding of a step above which no rate is guessed from it (fewer than four digits)."""
STEP_MARGIN = 1.02
"""Half units of the last digit by which a step may be off: it may be rounded half up, from single precision."""


FLOAT_ROUNDING = 1e-12
"""Relative, of one over a step in double precision."""


def plausible_rate(step: str) -> tuple[float, str]:
    """Sample rate [Hz] of a step [s] as it is written, and a note where the rate was rounded.

    A step of 1.52588E-05 s stands for every rate from 65535.8 to 65536.2 Hz. Where a whole number of hertz lies within
    this interval, the one of the fewest digits is taken: clocks are divided to whole rates. Else the rate is one over
    the step. Raises ValueError where the step is no positive number.
    """
    value = float(step.upper().replace("D", "E"))
    if not (0.0 < value < math.inf and math.isfinite(1.0 / value)):
        raise ValueError(f"a step of {step} s is no time")
    rate = 1.0 / value
    half_unit = STEP_MARGIN * _half_unit(step) / value
    low, high = rate * (1.0 - half_unit), rate * (1.0 + half_unit)
    integer_rate = _shortest_integer(low, high) if half_unit < LARGEST_WIDTH else None
    if integer_rate is None or integer_rate == rate:
        return whole_rate(rate), ""
    return float(integer_rate), f"a step of {step} s is taken as {integer_rate} Hz, not {rate:.7g} Hz"


def whole_rate(rate: float) -> float:
    """The rate [Hz], rounded to a whole number where it differs from one by rounding of the computer alone."""
    return float(round(rate)) if round(rate) > 0 and abs(rate - round(rate)) < FLOAT_ROUNDING * rate else rate


def _half_unit(step: str) -> float:
    """Half a unit of the last digit of a number as written."""
    mantissa, _, exponent = step.upper().replace("D", "E").partition("E")
    decimals = len(re.sub(r"[^0-9]", "", mantissa.partition(".")[2]))
    return 0.5 * 10.0 ** (int(exponent or 0) - decimals)


def _shortest_integer(low: float, high: float) -> int | None:
    """The whole number from low to high with the most trailing zeros; of several a multiple of a high power of two."""
    first, last = math.ceil(low), math.floor(high)
    if last < first:
        return None
    if last - first > 1000:
        return None
    return max(range(first, last + 1), key=lambda number: (_zeros(number, 10), _zeros(number, 2)))


def _zeros(number: int, base: int) -> int:
    count = 0
    while number and number % base == 0:
        number, count = number // base, count + 1
    return count
