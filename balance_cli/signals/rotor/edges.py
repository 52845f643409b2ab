"""Edges of a sampled tachometer: level crossings with hysteresis, between samples by band-limited interpolation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.io.errors import UserError

Array = NDArray[np.float64]
ReadSamples = Callable[[int, int], Array]
"""`read(start, stop)` returns samples (stop - start,)."""

BLOCK = 2**18
UPSAMPLING = 4
"""Samples in place of one: between them the band-limited signal is a cubic to 0.1 % of its swing."""
REACH = 24
"""Samples on either side by which a value between samples is interpolated."""
EXTREME_SHARE = 1e-3
"""Quantile that stands for the low and the high state: a pulse of 0.4 deg fills it, single spikes do not."""
FEWEST_JUMPS = 3
"""Jumps back by which a ramp is one that repeats: fewer pulses are refused anyway."""
UNEVENNESS = 0.1
"""Largest distance of the distribution of a ramp from an even one: noise of 5 % of the range and a speed that varies
stay below it, sines have 0.18 and pulses 0.5."""
HYSTERESIS = 0.2
"""Default half width of the hysteresis over the swing: four standard deviations of noise of 5 % of the swing."""


@dataclass(frozen=True)
class Levels:
    """Low and high state of a signal, and the level and half width of hysteresis by which edges are found."""

    low: float
    high: float
    level: float
    hysteresis: float

    @property
    def share(self) -> float:
        """Level above the low state over the swing."""
        return (self.level - self.low) / (self.high - self.low) if self.high > self.low else 0.5


@dataclass(frozen=True)
class Edges:
    """Times [s] from the first sample at which the signal rises and falls through the level."""

    rising: Array
    falling: Array


def find_levels(read: ReadSamples, samples: int, level: float | None, hysteresis: float | None) -> Levels:
    """Low and high state as the medians of the extreme quantiles of all blocks; what is given is taken as it is."""
    quantiles = [
        np.quantile(block, [EXTREME_SHARE, 1.0 - EXTREME_SHARE])
        for _, block in _blocks(read, samples, 0)
        if len(block) > 16
    ]
    if not quantiles:
        fault = f"holds {samples} samples, too few for its levels"
        raise UserError(fault, place="tachometer", remedy="Give a record of several revolutions")
    low, high = (float(value) for value in np.median(np.array(quantiles), axis=0))
    middle = 0.5 * (low + high) if level is None else level
    return Levels(low, high, middle, HYSTERESIS * (high - low) if hysteresis is None else hysteresis)


def is_ramp(signal: Array) -> bool:
    """Whether a signal passes evenly through its range and begins again, as an angle does: it has no pulses.

    It jumps through more than half of its range in one direction only, and its values are evenly distributed.
    """
    low, high = np.min(signal), np.max(signal)
    steps = np.diff(signal) / max(high - low, np.finfo(float).tiny)
    up, down = int(np.sum(steps > 0.5)), int(np.sum(steps < -0.5))
    if min(up, down) > 0 or max(up, down) < FEWEST_JUMPS:
        return False
    even = np.linspace(0.0, 1.0, len(signal))
    return bool(np.max(np.abs((np.sort(signal) - low) / (high - low) - even)) < UNEVENNESS)


def find_edges(read: ReadSamples, samples: int, rate: float, levels: Levels) -> Edges:
    """Find all edges: the last crossing of the level before the signal leaves the band of hysteresis."""
    rising: list[Array] = []
    falling: list[Array] = []
    state, up, down, end = 0, np.nan, np.nan, 0.0
    for start, fine in _fine_blocks(read, samples):
        above = fine - levels.level
        ups, downs = _crossings(above), _crossings(-above)
        outside = np.where(above > levels.hysteresis, 1, np.where(above < -levels.hysteresis, -1, 0))
        known = np.flatnonzero(outside)
        known = known[start + known >= end]  # blocks overlap: an edge there is found once
        states, end = outside[known], start + len(fine)
        changed = np.flatnonzero(np.diff(np.concatenate([[state or (states[0] if len(states) else 0)], states])))
        for index in known[changed]:
            if outside[index] > 0:
                rising.append(_last_before(ups, index, up, start))
            else:
                falling.append(_last_before(downs, index, down, start))
        state = int(states[-1]) if len(states) else state
        up = start + ups[-1] if len(ups) else up
        down = start + downs[-1] if len(downs) else down
    return Edges(_times(rising, rate), _times(falling, rate))


def _blocks(read: ReadSamples, samples: int, overlap: int) -> Iterator[tuple[int, Array]]:
    for start in range(0, samples, BLOCK):
        yield start, read(max(start - overlap, 0), min(start + BLOCK + overlap, samples))


def _fine_blocks(read: ReadSamples, samples: int) -> Iterator[tuple[float, Array]]:
    """Yield the place of the first value, in samples of UPSAMPLING, and the finer signal of each block.

    Blocks overlap by three values, for a cubic to be set between any two.
    """
    from scipy.signal import firwin, upfirdn  # their import takes longer than a reduction by pulse times

    taps = firwin(2 * REACH * UPSAMPLING + 1, 1.0 / UPSAMPLING, window=("kaiser", 8.0)) * UPSAMPLING
    for start in range(0, samples, BLOCK):
        stop = min(start + BLOCK + 1, samples)
        first, last = start - REACH - 1, stop + REACH + 1
        block = read(max(first, 0), min(last, samples))
        block = np.pad(block, (max(-first, 0), max(last - samples, 0)), mode="edge")
        fine = upfirdn(taps, block, up=UPSAMPLING)[REACH * UPSAMPLING :]
        inner = slice(REACH * UPSAMPLING, (REACH + 1 + stop - start) * UPSAMPLING + 2)
        yield float((start - 1) * UPSAMPLING), fine[inner]


def _crossings(signal: Array) -> Array:
    """Places of upward zero crossings, by the cubic through four values."""
    before = np.flatnonzero((signal[1:-2] < 0.0) & (signal[2:-1] >= 0.0)) + 1
    values = [signal[before + k] for k in (-1, 0, 1, 2)]
    low, high = np.zeros(len(before)), np.ones(len(before))
    for _ in range(24):  # bisection to 1e-7 of a step
        middle = 0.5 * (low + high)
        positive = _cubic(values, middle) >= 0.0
        low, high = np.where(positive, low, middle), np.where(positive, middle, high)
    return np.asarray(before + 0.5 * (low + high))


def _cubic(values: list[Array], x: Array) -> Array:
    """Cubic through values at -1, 0, 1 and 2."""
    a, b, c, d = values
    left, right = x + 1.0, x - 1.0
    return np.asarray(
        -a * x * right * (x - 2.0) / 6.0
        + b * left * right * (x - 2.0) / 2.0
        - c * left * x * (x - 2.0) / 2.0
        + d * left * x * right / 6.0
    )


def _last_before(crossings: Array, index: int, carried: float, start: float) -> Array:
    k = int(np.searchsorted(crossings, index)) - 1
    return np.array(start + crossings[k] if k >= 0 else carried)


def _times(places: list[Array], rate: float) -> Array:
    values = np.array(places, float) / (UPSAMPLING * rate)
    return values[np.isfinite(values)]
