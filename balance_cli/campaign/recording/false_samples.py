"""Samples that no channel measured: those of a buffer that was written twice, and spikes.

Noise makes no two samples equal in all channels, let alone a row of them at one distance. Where most of a record
repeats itself it was computed without noise, or is at rest.

A spike is a sample of a channel, or a few that are displaced alike, to which their neighbors do not lead (a bit that
flips on a link, a contact). All of one sign change the mean by their sum, and look like white noise whose sigma knows
only their scatter. Behind the anti-alias filter no load rises or falls from one sample to the next: of a spike the
fourth differences have the pattern of two steps.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Array, Run, read_channel_rows

Integers = NDArray[np.int64]

LEAST_BLOCK = 16
"""Samples of the shortest block: buffers are longer, and a coarse record at rest repeats a few by chance."""
LARGEST_SHARE = 0.5
"""Share of samples with an equal one before from which a record repeats itself throughout."""
BLOCK_SAMPLES = 65536
"""Samples that are read at a time."""
SPIKE_TO_SCATTER = 8.0
"""Fourth difference of a spike over the usual one, from which it is sought: noise reaches 7 once in 10^12 samples."""
LEFT_OF_SPIKE = 0.1
"""Share of a spike that the differences around it may have without it, beyond LEFT_OF_NOISE of the usual ones: a pulse
behind a filter at 0.45 of the sample rate leaves 0.2."""
LEFT_OF_NOISE, MOST_LEFT = 4.0, 0.3
"""Second, share of a spike that may be left beside noise, too: a single step leaves a third."""
LONGEST_SPIKE = 12
"""Samples of the longest spike: more apart, two steps may be those of two causes."""
MOST_DIFFERENCES = 0.1
"""Share of the samples with differences of such a size from which they are those of the signal."""
MEDIAN_OF_NORMAL = 0.6745
"""Median size of a normal deviate over its standard deviation."""
FOURTH_DIFFERENCE = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / 6.0
"""Of samples, one at a single one."""
MULTIPLIERS_SEED = 1
"""Of the odd numbers by which the bits of a sample are multiplied and summed, modulo 2^64."""


def repeated_block(run: Run) -> Integers:
    """Return the indices of the samples in which all channels, two or more, repeat an earlier block."""
    if len(run.channel_names) < 2:
        return np.empty(0, np.int64)
    starts = range(0, run.samples, BLOCK_SAMPLES)
    key = np.concatenate([_keys(read_channel_rows(run, run.channel_names, s, s + BLOCK_SAMPLES)) for s in starts])
    if np.count_nonzero(np.diff(np.sort(key)) == 0) < LEAST_BLOCK:
        return np.empty(0, np.int64)
    order = np.argsort(key, kind="stable")
    is_equal = key[order[1:]] == key[order[:-1]]
    later, lag = order[1:][is_equal], np.diff(order)[is_equal]
    if len(later) > LARGEST_SHARE * run.samples:
        return np.empty(0, np.int64)
    lag_of = np.zeros(run.samples, np.int64)
    lag_of[later] = lag
    # A sample that equals the one before is held, not copied.
    edges = np.concatenate([[0], np.flatnonzero(np.diff(lag_of)) + 1, [run.samples]])
    parts = [np.arange(a, b) for a, b in pairwise(edges.tolist()) if b - a >= LEAST_BLOCK and lag_of[a] > 1]
    return np.concatenate([np.empty(0, np.int64), *parts])


def _keys(rows: Array) -> NDArray[np.uint64]:
    """Return a number (n,) for each sample of all channels (c, n): equal where they are equal bit for bit."""
    rng = np.random.default_rng(MULTIPLIERS_SEED)
    odd = rng.integers(0, 2**63, len(rows), dtype=np.uint64) * np.uint64(2) + np.uint64(1)
    key = np.zeros(rows.shape[1], np.uint64)
    for bits, multiplier in zip(rows.view(np.uint64), odd, strict=True):
        mixed = bits >> np.uint64(29)
        mixed ^= bits
        mixed *= multiplier
        key += mixed ^ (mixed >> np.uint64(32))
    return key


def spikes(run: Run) -> dict[int, Integers]:
    """Return the indices of the samples of each column of the channels that are spikes."""
    parts: dict[int, list[Integers]] = {}
    margin = len(FOURTH_DIFFERENCE)
    for start in range(0, run.samples, BLOCK_SAMPLES):
        low = max(0, start - 2 * margin)
        rows = read_channel_rows(run, run.channel_names, low, start + BLOCK_SAMPLES + 2 * margin)
        for column, x in enumerate(rows):
            found = _spikes(x) + low
            found = found[(found >= start) & (found < start + BLOCK_SAMPLES)]
            if len(found):
                parts.setdefault(column, []).append(found)
    return {column: np.concatenate(found) for column, found in parts.items()}


def _spikes(x: Array) -> Integers:
    """Return the samples (k,) of a part (n,) of a channel that are spikes; those next to the ends are not examined."""
    none, reach = np.empty(0, np.int64), len(FOURTH_DIFFERENCE) - 1
    if len(x) < 4 * reach:
        return none
    d = np.convolve(x, FOURTH_DIFFERENCE, "valid")
    size = np.abs(d)
    usual = float(np.median(size)) / MEDIAN_OF_NORMAL
    if not usual > 0.0:  # a coarse converter at rest, or samples that are not finite
        return none
    at = np.flatnonzero(size > SPIKE_TO_SCATTER * usual)
    if len(at) > MOST_DIFFERENCES * len(x):
        return none
    parts = [none]
    for apart in (reach, LONGEST_SPIKE):  # spikes beside each other first, then the two ends of longer ones
        left = []
        for group in np.split(at, np.flatnonzero(np.diff(at) > apart) + 1) if len(at) else []:
            spike = _spike_of_group(d, int(group[0]), int(group[-1]), usual)
            parts.append(spike)
            left += [] if len(spike) else [group]
        at = np.concatenate([none, *left])
    return np.unique(np.concatenate(parts))


def _spike_of_group(d: Array, first: int, last: int, usual: float) -> Integers:
    """Return the samples of the spike whose fourth differences `d` exceed the usual ones from `first` to `last`.

    A spike of m samples has those of two steps that are m apart, which differ from zero at m + 4 places.
    """
    reach, none = len(FOURTH_DIFFERENCE) - 1, np.empty(0, np.int64)
    best, found = np.inf, none
    for length in range(max(1, last - first - reach + 1), min(last - first + 1, LONGEST_SPIKE) + 1):
        pattern = np.pad(np.convolve(np.ones(length), FOURTH_DIFFERENCE), reach)
        for start in range(last - length - reach + 1, first + 1):  # of the differences that the spike reaches
            low = start - reach
            if low < 0 or low + len(pattern) > len(d):
                continue
            around = d[low : low + len(pattern)]
            fitted = float(around @ pattern) / float(pattern @ pattern) * pattern
            left, largest = float(np.abs(around - fitted).max()), float(np.abs(fitted).max())
            if left < min(best, LEFT_OF_SPIKE * largest + LEFT_OF_NOISE * usual, MOST_LEFT * largest):
                best, found = left, np.arange(start + reach, start + reach + length)
    return found
