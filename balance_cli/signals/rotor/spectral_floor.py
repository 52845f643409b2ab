"""The floor of a spectrum: what a line must stand out of."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FEWEST_BINS = 48
"""Bins of a block at least: a line and its skirts fill a few of them, so that the median is that of the floor."""
MOST_BLOCKS = 96
"""Blocks of a spectrum at most: the floor follows resonances that are wider than one."""


def block_size(bins: int) -> int:
    """Return the bins of a block of a spectrum."""
    return max(FEWEST_BINS, -(-bins // MOST_BLOCKS))


def spectral_floor(power: Array) -> Array:
    """Return the floor (k, c) of spectra of power (k, c): the median of the bins of each block, one value a block.

    Each block takes in half of its neighbors, so that a resonance at the edge of a block is not taken for a line.
    """
    size = block_size(len(power))
    starts = np.arange(0, len(power), size)
    channels = np.ascontiguousarray(power.T)
    medians = [np.median(channels[:, max(0, start - size // 2) : start + size + size // 2], axis=1) for start in starts]
    return np.asarray(np.repeat(np.array(medians), size, axis=0)[: len(power)])
