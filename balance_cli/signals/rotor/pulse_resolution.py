"""The step of pulse times that are whole multiples of one: those of samples, or of a clock that counts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ROUNDING = 4.0
"""Units in the last place by which stated times depart from whole steps: of the step, the product and the file."""
LEAST_STEP = 20.0
"""Step over the error of rounding from which multiples are no chance: of times without a step, one in ten is one."""
FEWEST_PULSES = 12
"""One in ten by chance, twelve times over, is one in 10^12."""


def timing_step(times: Array) -> float:
    """Return the largest step [s] of which all differences of the times (p,) are multiples; 0 where none shows.

    Times that are evenly spaced throughout show none. Those of single precision are recognized as such.
    """
    if len(times) < FEWEST_PULSES:
        return 0.0
    single = np.array_equal(times, times.astype(np.float32))
    tolerance = ROUNDING * float(np.finfo(np.float32 if single else float).eps * np.abs(times).max())
    step = _common_divisor(np.abs(np.diff(times, 2)), LEAST_STEP * tolerance)
    if step == 0.0 or step > 0.5 * np.diff(times).min():
        return 0.0  # of pulses that are evenly spaced but for missing ones, the step is a revolution
    since_first = times - times[0]
    for _ in range(2):  # the step is known to its share of an interval, then of the record
        counts = np.concatenate([[0.0], np.cumsum(np.rint(np.diff(times) / step))])
        if not counts.any():
            return 0.0
        step = float(since_first @ counts / (counts @ counts))
    departure = np.abs(since_first - counts * step)
    return step if bool(np.all(departure <= tolerance)) and step > LEAST_STEP * tolerance else 0.0


def _common_divisor(values: Array, least: float) -> float:
    """Return the greatest common divisor of values (n,) by Euclid's algorithm; 0 where it is below `least`.

    A remainder below half of `least` is one of rounding.
    """
    divisor = 0.0
    for value in np.unique(values[values > 0.5 * least]):
        a, b = max(divisor, value), min(divisor, value)
        while b > 0.5 * least:
            remainder = a - b * np.rint(a / b)
            a, b = b, abs(remainder)
        divisor = float(a)
        if divisor < least:
            return 0.0
    return divisor
