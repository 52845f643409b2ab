"""The floor of a spectrum: what a line must stand out of."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.floating]

FEWEST_BINS = 48
"""Bins of a block at least: a line and its skirts fill a few of them, so that the median is that of the floor."""
MOST_BLOCKS = 96
"""Blocks of a spectrum at most: the floor follows resonances that are wider than one."""


PEAK_REACH = 3
"""Bins on either side of a line that its main lobe covers under the windows of Hann and Blackman."""


def block_size(bins: int) -> int:
    """Return the bins of a block of a spectrum."""
    return max(FEWEST_BINS, -(-bins // MOST_BLOCKS))


def spectral_floor(power: Real, bins: NDArray[np.int64] | None = None) -> Real:
    """Return the floor (c, k) of spectra of power (c, n) at k bins, by default all.

    It is the median of the bins of each block, one value a block. Each block takes in half of its neighbors, so that a
    resonance at the edge of a block is not taken for a line.
    """
    size = block_size(power.shape[1])
    block = np.arange(power.shape[1]) // size if bins is None else bins // size
    needed, place = np.unique(block, return_inverse=True)
    low, high = size * needed - size // 2, size * (needed + 1) + size // 2
    is_inside = (low >= 0) & (high <= power.shape[1])
    medians = np.empty((len(power), len(needed)), power.dtype)
    if is_inside.any():
        medians[:, is_inside] = row_medians(
            np.lib.stride_tricks.sliding_window_view(power, high[0] - low[0], 1)[:, low[is_inside]]
        )
    for k in np.flatnonzero(~is_inside):
        medians[:, k] = row_medians(power[:, max(0, low[k]) : high[k]])
    return np.asarray(medians[:, place])


def local_maxima(values: Real) -> NDArray[np.bool_]:
    """Return which values (k,) none within PEAK_REACH bins exceeds; the filter of scipy takes longer to import."""
    largest = values.copy()
    for step in range(1, PEAK_REACH + 1):
        np.maximum(largest[step:], values[:-step], out=largest[step:])
        np.maximum(largest[:-step], values[step:], out=largest[:-step])
    return np.asarray(values == largest)


def row_medians(values: Real) -> Real:
    """Return the medians along the last axis; numpy's own takes several times as long for rows of a hundred values.

    A vectorized sort of so few values takes two thirds of the time of a partition.
    """
    middle = values.shape[-1] // 2
    ordered = np.sort(values, axis=-1)
    if values.shape[-1] % 2:
        return np.asarray(ordered[..., middle])
    return np.asarray(0.5 * (ordered[..., middle - 1] + ordered[..., middle]))
