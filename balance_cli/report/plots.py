"""Plots as plain data: curves with bands over a common x, and markers; charts and static pictures are made of them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ENVELOPE_BINS = 2000
"""Bins of an envelope: with minimum and maximum of each, a point for each pixel of the widest screens (4k)."""


@dataclass(frozen=True)
class Trace:
    """One curve `y` (n,) over the x of its plot; `band` (2, n): its lower and upper limits.

    `points`: symbols without a line. `compact`: 16 bits are enough for its values on the page.
    """

    label: str
    y: Array
    color: str
    dashes: tuple[float, ...] = ()
    width: float = 1.4
    band: Array | None = None
    points: bool = False
    compact: bool = False


@dataclass(frozen=True)
class Marker:
    """A vertical line at `x` with a short label."""

    x: float
    label: str


@dataclass(frozen=True)
class Plot:
    """One pair of axes: x (n,) ascending, traces over it, axis labels with units, markers; limits of y where fixed."""

    title: str
    x: Array
    traces: tuple[Trace, ...]
    x_label: str
    y_label: str
    log_y: bool = False
    markers: tuple[Marker, ...] = ()
    limits: tuple[float, float] | None = None
    height: int = 220


def envelope(x: Array, y: Array, bins: int = ENVELOPE_BINS) -> tuple[Array, Array]:
    """Return a curve of at most 2 `bins` points with the minimum and maximum of each bin, in the order of x.

    Short curves are returned as they are. No extreme is lost, whatever the zoom.
    """
    n = len(x)
    if n <= 2 * bins:
        return x, y
    edges = np.linspace(0, n, bins + 1).astype(int)
    index = np.empty(2 * bins, int)
    filled = np.where(np.isfinite(y), y, 0.0)
    for i, (start, stop) in enumerate(pairwise(edges)):
        part = filled[start:stop]
        low, high = start + int(np.argmin(part)), start + int(np.argmax(part))
        index[2 * i], index[2 * i + 1] = min(low, high), max(low, high)
    index = np.unique(index)
    return x[index], y[index]


def rotor_markers(speed: float, low: float, high: float, blades: int = 0, most: int = 40) -> tuple[Marker, ...]:
    """Return markers at the multiples of the rotor speed [Hz] within low to high; only multiples of `blades` are named.

    Without blades every multiple is named. None where there would be more than `most`.
    """
    if not speed > 0 or (high - low) / speed > most:
        return ()
    orders = range(max(1, int(np.ceil(low / speed))), int(np.floor(high / speed)) + 1)
    return tuple(Marker(n * speed, f"{n}/rev" if not blades or n == 1 or n % blades == 0 else "") for n in orders)
