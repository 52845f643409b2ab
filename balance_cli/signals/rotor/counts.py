"""Revolutions of an encoder: a channel that counts, or the angle of the rotor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.io.errors import UserError
from balance_cli.signals.rotor.edges import BLOCK, ReadSamples

Array = NDArray[np.float64]

COUNTER_SIZES = (2.0**8, 2.0**16, 2.0**24, 2.0**32)
"""At which the registers of counters begin anew."""
COUNTS_REMEDY = (
    "Correct `counts_per_revolution`, or read the jumps of an angle that a filter has smeared: `kind: pulses`, `slope`"
)
FEWEST_JUMPS = 10
"""Jumps back from which their mean size is known."""
LARGEST_SCALE_ERROR = 0.05
"""Error of the scale of a converter over a revolution, beyond which the declared counts are taken to be wrong."""


def revolution_crossings(
    read: ReadSamples, samples: int, rate: float, counts_per_revolution: float
) -> tuple[Array, list[str]]:
    """Times [s] at which the count passes a multiple of a revolution, between the samples by interpolation.

    The count begins anew after a revolution, or at the size of its register. A whole number stands for the middle of
    its step. Noise passes a multiple several times: the middle of the first and the last of them counts. Raises
    UserError where the channel does not count.
    """
    low, high, is_whole = _range(read, samples)
    modulus = _modulus(high - low, counts_per_revolution, is_whole)
    middle = 0.5 if is_whole else 0.0
    sign = _direction(read, samples, modulus)
    notes = ["the count decreases; azimuth was taken to increase"] if sign < 0 else []
    if high - low > 2.0 * counts_per_revolution:
        multiple = f"azimuth 0 is where it is a multiple of {counts_per_revolution:g}"
        notes.append(f"the count goes on from revolution to revolution: {multiple}, if it was zero at the index once")
    if modulus == counts_per_revolution:
        modulus = _measured_revolution(read(0, min(samples, BLOCK)), modulus)
        if modulus != counts_per_revolution:
            notes.append(f"the count begins anew after {modulus:.5g}, which was taken as a revolution")
            counts_per_revolution = modulus
    before, turns, passages = None, 0.0, []
    for start in range(0, samples, BLOCK):
        counts = sign * read(start, min(start + BLOCK, samples))
        joined = counts if before is None else np.concatenate([[before], counts])
        steps = _continued(np.diff(joined), modulus)
        begin = (joined[0] + turns) if before is not None else counts[0]
        unwrapped = begin + np.concatenate([[0.0], np.cumsum(steps)]) + middle
        turns, before = unwrapped[-1] - middle - counts[-1], counts[-1]
        first = start - (0 if len(joined) == len(counts) else 1)
        passages.append(_passages(unwrapped / counts_per_revolution, first))
    crossings = _middle_passages(*(np.concatenate(parts, axis=1) for parts in zip(*passages, strict=True))) / rate
    if len(crossings) < 3:
        fault = f"passes {len(crossings)} revolutions of {counts_per_revolution:g} counts"
        raise UserError(fault, place="tachometer", remedy=COUNTS_REMEDY)
    return crossings, notes


def _range(read: ReadSamples, samples: int) -> tuple[float, float, bool]:
    low, high, is_whole = np.inf, -np.inf, True
    for start in range(0, samples, BLOCK):
        counts = read(start, min(start + BLOCK, samples))
        if not np.all(np.isfinite(counts)):
            raise UserError("has samples that are not finite", place="tachometer", remedy="Repair or cut the record")
        low, high = min(low, float(counts.min())), max(high, float(counts.max()))
        is_whole = is_whole and bool(np.all(counts == np.rint(counts)))
    return low, high, is_whole


def _modulus(swing: float, counts_per_revolution: float, is_whole: bool) -> float:
    """Counts after which the channel begins anew: a revolution, or the size of a register of whole numbers.

    A count that never begins anew is not changed by it, as its steps are less than half a revolution.
    """
    if not is_whole or swing <= counts_per_revolution:
        return counts_per_revolution
    return next((size for size in COUNTER_SIZES if 0.9 * size < swing < size), counts_per_revolution)


def _continued(steps: Array, modulus: float) -> Array:
    """Steps of the count without those at which it begins anew."""
    return np.asarray(steps - modulus * np.rint(steps / modulus))


def _measured_revolution(counts: Array, revolution: float) -> float:
    """Counts after which the channel begins anew: those declared, or the range of a converter that is scaled otherwise.

    Raises UserError where its jumps back are none of a revolution, as those that a filter has smeared.
    """
    steps = np.diff(counts)
    jumps = np.abs(steps) > 0.5 * revolution
    sizes = np.abs(steps[jumps] - float(np.mean(steps[~jumps])))
    if len(sizes) < FEWEST_JUMPS or np.any(sizes > 1.5 * revolution):
        return revolution
    size, error = float(np.mean(sizes)), float(np.std(sizes)) / np.sqrt(len(sizes))
    resolution = float(np.min(np.diff(np.unique(counts))))
    if abs(size - revolution) <= max(5.0 * error, 1e-3 * revolution, resolution):
        return revolution
    if abs(size - revolution) > LARGEST_SCALE_ERROR * revolution:
        fault = f"begins anew after {size:.5g} counts, not {revolution:.5g}"
        raise UserError(fault, place="tachometer", remedy=COUNTS_REMEDY)
    return size


def _direction(read: ReadSamples, samples: int, modulus: float) -> float:
    steps = np.diff(read(0, min(BLOCK, samples)))
    total = float(_continued(steps, modulus).sum())
    if total == 0.0:
        raise UserError("does not count", place="tachometer", remedy="Give the channel of the encoder")
    return 1.0 if total > 0.0 else -1.0


def _passages(turns: Array, first: int) -> tuple[Array, Array]:
    """First and last passages of whole numbers by a count of revolutions, each (2, p): number, and place in samples."""
    begin, end = _first_passages(turns), _first_passages(-turns[::-1])
    end = np.stack([-end[0], len(turns) - 1 - end[1]])[:, ::-1]
    shift = np.array([[0.0], [first]])
    return begin + shift, end + shift


def _first_passages(turns: Array) -> Array:
    """Numbers and places (2, p) at which a count first passes whole numbers, by interpolation between samples."""
    highest = np.maximum.accumulate(turns)
    revolutions = np.floor(highest)
    passed = np.flatnonzero(np.diff(revolutions) > 0)
    rise = highest[passed + 1] - highest[passed]
    return np.stack([revolutions[passed + 1], passed + (revolutions[passed + 1] - highest[passed]) / rise])


def _middle_passages(begin: Array, end: Array) -> Array:
    """Places (p,) midway between the first and the last passage of each number."""
    _, i, j = np.intersect1d(begin[0], end[0, ::-1], return_indices=True)
    return np.asarray(0.5 * (begin[1, i] + end[1, ::-1][j]))
