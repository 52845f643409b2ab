"""Wind runs whose harmonics are those of the run before, turned by one angle of azimuth: the pulses moved.

Pulses from the other edge of a mark turn harmonic n of every load by n times one angle. Within a record nothing shows
it, as some rotor makes such loads. But two points of a test are seldom so alike, and turned.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from balance_cli.reduction.result import RunLoads

Array = NDArray[np.float64]

LEAST_SIGNAL = 5.0
"""Amplitude of a load over its sigma from which its phase is compared."""
FEWEST_HARMONICS, FEWEST_LOADS = 3, 9
"""Compared at least: one or two phases always have an angle in common."""
LEAST_CORRELATION = 0.9
"""Of the turned loads. Loads that differ by half of their size from those of the other run have 0.9 in the median; of
2000 pairs of loads with nothing in common none has it."""
SMALLEST_TURN = 3.0
"""[deg]. The angle of loads that differ by half of their size scatters by 0.6 deg."""
TIE = 1e-3
"""Difference of two correlations that rounding and steps make."""
LARGEST_TURN, STEP = 60.0, 0.25
"""[deg] that are tried: half of a sector of three marks, and steps below the scatter."""


def turn_warnings(runs: Iterable[RunLoads]) -> Iterator[str]:
    """Yield a warning for each wind run whose harmonics are those of the wind run before, turned."""
    for before, after in pairwise(run for run in runs if run.kind == "wind"):
        turn = common_turn(before, after)
        if turn is not None and abs(turn) > SMALLEST_TURN:
            yield (
                f"{after.run}: its harmonics n are those of {before.run} turned by n times {turn:+.1f} deg of azimuth: "
                "do the pulses come from another edge or mark, or was the model yawed?"
            )


def common_turn(before: RunLoads, after: RunLoads) -> float | None:
    """Return the angle [deg] by which all harmonics of a run are turned to be those of the other; None without one.

    Each load counts alike, whatever its size and unit.
    """
    if before.components != after.components or before.rotor != after.rotor:
        return None
    count = min(len(before.amplitude), len(after.amplitude))
    first, second = before.amplitude[1:count], after.amplitude[1:count]
    clear = _clear(before)[1:count] & _clear(after)[1:count]
    if clear.any(axis=1).sum() < FEWEST_HARMONICS or clear.sum() < FEWEST_LOADS:
        return None
    with np.errstate(invalid="ignore", divide="ignore"):
        alike = 2.0 * first.conj() * second / (np.abs(first) ** 2 + np.abs(second) ** 2)
    products = np.where(clear, alike, 0.0).sum(axis=1) / clear.sum()
    turns = np.arange(-LARGEST_TURN, LARGEST_TURN + STEP, STEP)
    correlation = (np.exp(-1j * np.outer(np.radians(turns), np.arange(1, count))) @ products).real
    # Where only multiples of the blades are clear, several angles explain the same; the smallest one is meant.
    equal = turns[correlation > correlation.max() - TIE]
    return float(equal[np.argmin(np.abs(equal))]) if correlation.max() > LEAST_CORRELATION else None


def _clear(run: RunLoads) -> NDArray[np.bool_]:
    """Return which loads (n+1, m) stand out of their sigma."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(run.amplitude) > LEAST_SIGNAL * np.hypot(run.sigma_cosine, run.sigma_sine))
