"""A buffer that an acquisition wrote twice: a block of samples equal to an earlier one in all channels.

Noise makes no two samples equal in all channels, let alone a row of them at one distance. Where most of a record
repeats itself it was computed without noise, or is at rest.
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
