"""Wind runs whose loads are those of the run before, turned by one angle of azimuth or of the opposite sign.

Pulses from the other edge of a mark turn harmonic n of every load by n times one angle; channels that are all reversed
turn every load, whatever its harmonic, by half a cycle. Within a record nothing shows either, as some rotor makes such
loads. But two points of a test are seldom so alike, and turned.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from balance_cli.reduction.result import RunLoads

ComplexArray = NDArray[np.complex128]

LEAST_SIGNAL = 5.0
"""Amplitude of a load over its sigma from which its phase is compared."""
FEWEST_HARMONICS, FEWEST_LOADS = 3, 9
"""Compared at least: one or two phases always have an angle in common."""
FEWEST_MEANS = 5
"""Mean loads from which their signs are compared, where the harmonics are not alike."""
LEAST_CORRELATION = 0.9
"""Of the turned or reversed loads. Loads that differ by half of their size from those of the other run have 0.9 in the
median. Of 2000 pairs of loads with nothing in common none has it; of 10 000 pairs of six mean loads two have -0.9."""
SMALLEST_TURN = 3.0
"""[deg]. The angle of loads that differ by half of their size scatters by 0.6 deg."""
TIE = 1e-3
"""Difference of two correlations that rounding and steps make."""
LARGEST_TURN, STEP = 60.0, 0.25
"""[deg] that are tried: half of a sector of three marks, and steps below the scatter."""


def turn_warnings(runs: Iterable[RunLoads]) -> Iterator[str]:
    """Yield a warning for each wind run whose loads are those of the wind run before, turned or reversed."""
    for before, after in pairwise(run for run in runs if run.kind == "wind"):
        turn = common_turn(before, after)
        if is_reversed(before, after):
            yield (
                f"{after.run}: its loads are those of {before.run} with the opposite sign: "
                "were all channels reversed in one of them?"
            )
        elif turn is not None and abs(turn) > SMALLEST_TURN:
            yield (
                f"{after.run}: its harmonics n are those of {before.run} turned by n times {turn:+.1f} deg of azimuth: "
                "do the pulses come from another edge or mark, or was the model yawed?"
            )


def common_turn(before: RunLoads, after: RunLoads) -> float | None:
    """Return the angle [deg] by which all harmonics of a run are turned to be those of the other; None without one.

    Each load counts alike, whatever its size and unit.
    """
    products = _harmonic_products(before, after)
    if products is None:
        return None
    turns = np.arange(-LARGEST_TURN, LARGEST_TURN + STEP, STEP)
    correlation = (np.exp(-1j * np.outer(np.radians(turns), np.arange(1, len(products) + 1))) @ products).real
    # Where only multiples of the blades are clear, several angles explain the same; the smallest one is meant.
    equal = turns[correlation > correlation.max() - TIE]
    return float(equal[np.argmin(np.abs(equal))]) if correlation.max() > LEAST_CORRELATION else None


def is_reversed(before: RunLoads, after: RunLoads) -> bool:
    """Return whether the harmonics of a run, or its mean loads, are those of the other with the opposite sign.

    The harmonics decide where they are alike; those of another phase tell nothing, and mean loads keep their sign.
    """
    products = _harmonic_products(before, after)
    if products is not None and abs(products.sum().real) > LEAST_CORRELATION:
        return bool(products.sum().real < 0.0)
    clear, alike = _likeness(before, after)
    return bool(clear[0].sum() >= FEWEST_MEANS and alike[0, clear[0]].real.mean() < -LEAST_CORRELATION)


def _harmonic_products(before: RunLoads, after: RunLoads) -> ComplexArray | None:
    """Return the part (n,) of each harmonic in the correlation of two runs; None where too few loads are clear."""
    clear, alike = (values[1:] for values in _likeness(before, after))
    if clear.any(axis=1).sum() < FEWEST_HARMONICS or clear.sum() < FEWEST_LOADS:
        return None
    return np.asarray(np.where(clear, alike, 0.0).sum(axis=1) / clear.sum())


def _likeness(before: RunLoads, after: RunLoads) -> tuple[NDArray[np.bool_], ComplexArray]:
    """Return which loads (n+1, m) are clear in two runs, and the product of each over the mean of its squares.

    None is clear where the loads are not of the same components and rotor.
    """
    count = min(len(before.amplitude), len(after.amplitude))
    if before.components != after.components or before.rotor != after.rotor:
        return np.zeros((count, 0), bool), np.zeros((count, 0), complex)
    first, second = before.amplitude[:count], after.amplitude[:count]
    with np.errstate(invalid="ignore", divide="ignore"):
        alike = 2.0 * first.conj() * second / (np.abs(first) ** 2 + np.abs(second) ** 2)
    return _clear(before)[:count] & _clear(after)[:count], alike


def _clear(run: RunLoads) -> NDArray[np.bool_]:
    """Return which loads (n+1, m) stand out of their sigma."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(run.amplitude) > LEAST_SIGNAL * np.hypot(run.sigma_cosine, run.sigma_sine))
