"""Scales of static plots: limits, ticks at round numbers, and places on the picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.report.number_format import MINUS

Array = NDArray[np.float64]

TICKS = 5
"""Intervals between ticks that are aimed at."""
MOST_DECADES = 6.0
"""Decades of a logarithmic axis at most: deeper notches would flatten the rest."""


@dataclass(frozen=True)
class Scale:
    """A linear or logarithmic axis from `low` to `high`, at the places `start` to `stop` of the picture."""

    low: float
    high: float
    start: float
    stop: float
    log: bool
    ticks: tuple[float, ...]

    def at(self, value: float) -> float:
        """Return the place of a value; values outside are drawn at the edge."""
        low, high = (math.log(self.low), math.log(self.high)) if self.log else (self.low, self.high)
        position = (math.log(max(value, self.low)) if self.log else value) - low
        return self.start + (self.stop - self.start) * min(max(position / (high - low), 0.0), 1.0)

    def places(self, values: Array) -> Array:
        """Return the places (n,) of values (n,), NaN where one has none.

        Values outside lie at most a tenth of the axis beyond its ends: to be clipped there.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            scaled = np.log(values) if self.log else np.asarray(values, float)
        low, high = (math.log(self.low), math.log(self.high)) if self.log else (self.low, self.high)
        share = np.where(scaled == -np.inf, -np.inf, (scaled - low) / (high - low))
        return np.asarray(self.start + (self.stop - self.start) * np.clip(share, -0.1, 1.1))


def make_scale(
    values: Sequence[Array],
    start: float,
    stop: float,
    log: bool = False,
    limits: tuple[float, float] | None = None,
    margin: float = 0.0,
) -> Scale:
    """Return the scale that holds the finite values (only positive ones on a logarithmic axis)."""
    parts = [np.asarray(part)[np.isfinite(part)] for part in values]
    known = np.concatenate(parts) if parts else np.zeros(0)
    known = known[known > 0] if log else known
    low, high = limits or ((float(known.min()), float(known.max())) if len(known) else (0.1, 1.0))
    if log:
        low = max(low, high / 10**MOST_DECADES)
        low, high = (low / 1.2, high * 1.2) if limits is None else (low, high)
        return Scale(low, high, start, stop, True, _decades(low, high))
    if not high > low:
        half = abs(low) * 0.01 or 1.0
        low, high = low - half, high + half
    spare = margin * (high - low) if limits is None else 0.0
    low, high = low - spare, high + spare
    return Scale(low, high, start, stop, False, _round_ticks(low, high))


def _round_ticks(low: float, high: float) -> tuple[float, ...]:
    raw = (high - low) / TICKS
    size = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * size for factor in (1.0, 2.0, 5.0, 10.0) if factor * size >= raw * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return tuple(i * step for i in range(first, last + 1))


def _decades(low: float, high: float) -> tuple[float, ...]:
    factors = (1.0,) if high / low > 100.0 else (1.0, 2.0, 5.0)
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return tuple(f * 10.0**p for p in powers for f in factors if low <= f * 10.0**p <= high)


def tick_text(value: float, scale: Scale) -> str:
    """Return the label of a tick: the digits that tell it from its neighbors."""
    if not scale.log and len(scale.ticks) > 1:
        step = scale.ticks[1] - scale.ticks[0]
        if 1e-4 <= step < 1e6 and abs(value) < 1e6:
            text = f"{value:.{max(0, -math.floor(math.log10(step) + 1e-9))}f}"
            return text.lstrip("-") if float(text) == 0 else text.replace("-", MINUS)
    text = f"{value:.4g}"
    return text.replace("e-0", "e-").replace("e+0", "e").replace("e+", "e").replace("-", MINUS)
