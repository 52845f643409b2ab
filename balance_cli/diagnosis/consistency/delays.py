"""Channels of a check run that are later against the loads than in the sweeps, by one time at all frequencies."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LARGEST_REMAINDER = 0.1
"""Share of the squared departures that a delay may leave: another rig or another gain bends or scales the response."""
SMALLEST_PHASE = 0.15
"""[rad] at the highest line; below, the departures are those that bands and noise make."""
STEP = 0.02
"""[cycles] of the highest line between the delays that are tried."""


def common_delay(frequency: Array, measured: ComplexArray, predicted: ComplexArray) -> float | None:
    """Return the delay [s] of measured (k, c) after predicted readings (k, c) at k lines; None where none explains it.

    Each line counts alike. Of the delays up to half a period of the lowest line the one of least squares is taken.
    """
    size = np.sum(np.abs(predicted) ** 2, axis=1)
    product = np.sum(predicted.conj() * measured, axis=1) / size
    longest, step = 0.5 / frequency.min(), STEP / frequency.max()
    delays = np.arange(-longest, longest + step, step)
    score = (np.exp(2j * np.pi * np.outer(delays, frequency)) @ product).real
    best = int(np.argmax(score))
    delay = delays[best]
    if 0 < best < len(delays) - 1:  # the vertex of the parabola through three scores
        below, top, above = score[best - 1 : best + 2]
        delay += 0.5 * step * (below - above) / (below - 2.0 * top + above)
    late = predicted * np.exp(-2j * np.pi * delay * frequency)[:, None]
    before, after = (np.sum(np.abs(measured - x) ** 2 / size[:, None]) for x in (predicted, late))
    explains = after < LARGEST_REMAINDER * before and abs(2 * np.pi * delay * frequency.max()) > SMALLEST_PHASE
    return float(delay) if explains else None
