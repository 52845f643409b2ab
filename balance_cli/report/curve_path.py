"""Curves with many points as short SVG paths of integers, with the extremes of every few units kept."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BIN = 6.0
"""Width of the bins of a curve: three pixels at two units a pixel, a little more than the width of its line."""
FLAT = 3.0
"""Where a curve moves less than this within a bin, half of its line, the bin is drawn as one point."""


def curve_path(x: Array, y: Array) -> str:
    """Return the path of a curve at places x, y (n,), x ascending; it is interrupted where y is not finite."""
    return "".join(_segment(*_extremes(x[part], y[part])) for part in _finite_parts(y))


def area_path(x: Array, y: Array, bottom: float) -> str:
    """Return the path of the area between a curve and `bottom`."""
    words = []
    for part in _finite_parts(y):
        xs, ys = _extremes(x[part], y[part])
        words.append(_segment(np.r_[xs[0], xs, xs[-1]], np.r_[bottom, ys, bottom]) + "z")
    return "".join(words)


def _finite_parts(y: Array) -> Iterator[slice]:
    edges = np.flatnonzero(np.diff(np.r_[False, np.isfinite(y), False].astype(int)))
    for start, stop in edges.reshape(-1, 2):
        yield slice(int(start), int(stop))


def _extremes(x: Array, y: Array) -> tuple[Array, Array]:
    """Return the lowest and highest place of each bin in their order, one where they nearly agree; the ends stay."""
    starts = np.flatnonzero(np.diff(np.r_[-np.inf, np.floor(x / BIN)]) > 0)
    if len(starts) >= len(x) // 2:
        return x, y
    stops = np.r_[starts[1:], len(x)]
    low, high = np.minimum.reduceat(y, starts), np.maximum.reduceat(y, starts)
    # What only rises or falls within a bin runs from its first to its last place.
    places = np.stack([x[starts], x[stops - 1]], axis=1)
    rising = y[stops - 1] >= y[starts]
    pairs = np.stack([np.where(rising, low, high), np.where(rising, high, low)], axis=1)
    flat = high - low < FLAT
    pairs[flat] = 0.5 * (low + high)[flat, None]
    places[flat] = places[flat].mean(axis=1, keepdims=True)
    keep = np.stack([np.ones(len(flat), bool), ~flat], axis=1)
    return np.r_[x[0], places[keep], x[-1]], np.r_[y[0], pairs[keep], y[-1]]


def _segment(x: Array, y: Array) -> str:
    """Return one line: its first point, and the steps from point to point."""
    points = np.stack([np.rint(x), np.rint(y)], axis=1).astype(int)
    steps = np.diff(points, axis=0)
    first = f"M{points[0, 0]} {points[0, 1]}"
    if not len(steps):
        return f"{first}h0"
    return f"{first}l{' '.join(map(str, steps.ravel().tolist()))}".replace(" -", "-")
