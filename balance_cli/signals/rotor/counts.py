"""Revolutions of an encoder: a channel that counts, or the angle of the rotor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.io.errors import UserError
from balance_cli.signals.rotor.edges import BLOCK, ReadSamples

Array = NDArray[np.float64]

COUNTER_SIZES = (2.0**8, 2.0**16, 2.0**24, 2.0**32)
"""At which the registers of counters begin anew."""


def revolution_crossings(
    read: ReadSamples, samples: int, rate: float, counts_per_revolution: float
) -> tuple[Array, list[str]]:
    """Times [s] at which the count passes a multiple of a revolution, between the samples by interpolation.

    The count begins anew after a revolution, or at the size of its register. A whole number stands for the middle of
    its step. Raises UserError where the channel does not count.
    """
    low, high, is_whole = _range(read, samples)
    modulus = _modulus(high - low, counts_per_revolution)
    middle = 0.5 if is_whole else 0.0
    before, turns, times = None, 0.0, []
    sign = _direction(read, samples, modulus)
    for start in range(0, samples, BLOCK):
        counts = sign * read(start, min(start + BLOCK, samples))
        joined = counts if before is None else np.concatenate([[before], counts])
        steps = np.diff(joined)
        steps -= modulus * np.rint(steps / modulus) if modulus else 0.0
        begin = (joined[0] + turns) if before is not None else counts[0]
        unwrapped = begin + np.concatenate([[0.0], np.cumsum(steps)]) + middle
        turns, before = unwrapped[-1] - middle - counts[-1], counts[-1]
        first = start - (0 if len(joined) == len(counts) else 1)
        times.append((first + _passages(unwrapped / counts_per_revolution)) / rate)
    crossings = np.concatenate(times)
    if len(crossings) < 3:
        fault = f"passes {len(crossings)} revolutions of {counts_per_revolution:g} counts"
        raise UserError(fault, place="tachometer", remedy="Correct `counts_per_revolution`")
    return crossings, ["the count decreases; azimuth was taken to increase"] if sign < 0 else []


def _range(read: ReadSamples, samples: int) -> tuple[float, float, bool]:
    low, high, is_whole = np.inf, -np.inf, True
    for start in range(0, samples, BLOCK):
        counts = read(start, min(start + BLOCK, samples))
        if not np.all(np.isfinite(counts)):
            raise UserError("has samples that are not finite", place="tachometer", remedy="Repair or cut the record")
        low, high = min(low, float(counts.min())), max(high, float(counts.max()))
        is_whole = is_whole and bool(np.all(counts == np.rint(counts)))
    return low, high, is_whole


def _modulus(swing: float, counts_per_revolution: float) -> float:
    """Counts after which the channel begins anew: a revolution where its swing is one, else that of a register."""
    if swing <= counts_per_revolution * (1.0 + 1e-9):
        return counts_per_revolution
    return next((size for size in COUNTER_SIZES if 0.9 * size < swing < size), 0.0)


def _direction(read: ReadSamples, samples: int, modulus: float) -> float:
    steps = np.diff(read(0, min(BLOCK, samples)))
    steps -= modulus * np.rint(steps / modulus) if modulus else 0.0
    total = float(steps.sum())
    if total == 0.0:
        raise UserError("does not count", place="tachometer", remedy="Give the channel of the encoder")
    return 1.0 if total > 0.0 else -1.0


def _passages(turns: Array) -> Array:
    """Places at which a count of revolutions passes whole numbers, by interpolation between samples."""
    highest = np.maximum.accumulate(turns)
    revolutions = np.floor(highest)
    passed = np.flatnonzero(np.diff(revolutions) > 0)
    rise = highest[passed + 1] - highest[passed]
    return np.asarray(passed + (revolutions[passed + 1] - highest[passed]) / rise)
