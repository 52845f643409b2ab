"""A missing sample in a record so short that a straight line through its times is off by half a step at most."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.io.errors import UserError

Array = NDArray[np.float64]

LONG_STEP = 1.5
"""Median steps from which one may have a sample missing within it."""
LEAST_SHIFT = 0.75
"""Steps by which the times behind it must stay later: a computer that was late once has a short step next."""
JITTER, JITTER_SHARE = 0.25, 0.1
"""Of the median step, and of the steps that may differ by more: of times that scatter more nothing is known."""
NEIGHBORS = 8
"""Times on either side whose median tells the shift."""
WHOLE = 1e-3
"""Of the shortest step, by which rounded steps differ from multiples of it."""


def require_no_gap(times: Array) -> None:
    """Raise UserError, with the sample, where times (n,) that are even elsewhere stay a step later from some row on.

    Several long steps, where all are multiples of the shortest one, are those of rounded times.
    """
    steps = np.diff(times)
    median = float(np.median(steps))
    if steps.min() <= 0.0 or np.mean(np.abs(steps - median) > JITTER * median) > JITTER_SHARE:
        return
    long = np.flatnonzero(steps >= LONG_STEP * median)
    multiples = steps / steps.min()
    if len(long) > 1 and np.all(np.abs(multiples - np.round(multiples)) < WHOLE):
        return
    residual = times / median - np.arange(len(times))
    for place in long:
        before, behind = residual[max(place + 1 - NEIGHBORS, 0) : place + 1], residual[place + 1 :][:NEIGHBORS]
        if np.median(behind) - np.median(before) >= LEAST_SHIFT:
            fault = f"the times are not even: a step is {steps[place] / median:.3g} times the others"
            remedy = "Cut the record at the gap, or give the sample rate in the map"
            raise UserError(fault, place=f"sample {place + 2}", remedy=remedy)
