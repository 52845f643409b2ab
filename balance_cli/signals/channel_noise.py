"""The clean samples of a run, and the variance of the noise of its channels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run, read_channel_rows, read_channels
from balance_cli.campaign.rig.geometry import Acquisition
from balance_cli.signals.cross_spectra import MAIN_LOBE, noise_variance_above

Array = NDArray[np.float64]
Real = NDArray[np.floating]

WINDOW_TIME = 1.28
"""Length [s] of a window: short enough that harmonics of a drifting rotor speed remain narrow."""
LOAD_FREE_CUTOFF_FACTOR = 1.6
"""Multiple of the cutoff of the anti-alias filter above which only noise is expected: six poles leave 6 % of a load."""
LOAD_FREE_NYQUIST_SHARE = 0.9
"""Share of the Nyquist frequency above which bins count as free of loads where the filter leaves none free."""
LOAD_FREE_BINS = 5
"""Bins above all loads that a record of a third of a window's length has in one longer window."""
BLOCK_SAMPLES = 32768
"""Samples that are read at a time: 4 MB of 15 channels."""


@dataclass(frozen=True)
class CleanRecord:
    """Spans (start, stop) of samples of a run in which all channels `names` are good."""

    run: Run
    names: tuple[str, ...]
    spans: tuple[tuple[int, int], ...]

    @property
    def step(self) -> float:
        """Time [s] between samples."""
        assert self.run.sample_rate is not None
        return 1.0 / self.run.sample_rate

    def parts(self) -> Iterator[tuple[int, Array]]:
        """Yield first sample and samples (n, c) of each block."""
        for first, end in self._blocks():
            yield first, read_channels(self.run, self.names, first, end)

    def channel_parts(self) -> Iterator[Array]:
        """Yield the samples (c, n) of each block, a row for each channel."""
        for first, end in self._blocks():
            yield read_channel_rows(self.run, self.names, first, end)

    def _blocks(self) -> Iterator[tuple[int, int]]:
        for start, stop in self.spans:
            for first in range(start, stop, BLOCK_SAMPLES):
                yield first, min(first + BLOCK_SAMPLES, stop)

    def window(self, seconds: float) -> int:
        """Return the samples of a window of about `seconds`: a power of two, at most a third of the longest span."""
        return _window(seconds / self.step, max(stop - start for start, stop in self.spans))


def _window(samples: float, longest: int) -> int:
    return int(2 ** np.round(np.log2(max(min(samples, longest / 3), 4 * MAIN_LOBE))))


def channel_noise(clean_record: CleanRecord, acquisition: Acquisition) -> Array:
    """Return the noise variance (c,) [V2] of one sample of each channel, from frequencies above all loads."""
    lowest = _lowest_load_free_frequency(acquisition, 0.5 / clean_record.step)
    return noise_variance_above(
        lowest, clean_record.channel_parts(), clean_record.step, clean_record.window(WINDOW_TIME)
    )


def row_noise(rows: Real, sample_rate: float, acquisition: Acquisition) -> Array:
    """Return the same, in the square of their unit, of one stretch of rows (c, m), in their precision."""
    lowest = _lowest_load_free_frequency(acquisition, 0.5 * sample_rate)
    window, samples = _window(WINDOW_TIME * sample_rate, rows.shape[1]), rows.shape[1]
    if window * (0.5 - lowest / sample_rate) < MAIN_LOBE + 2:  # no bin between the loads and the main lobe at the end
        window = min(samples, int(np.ceil((MAIN_LOBE + LOAD_FREE_BINS) / (0.5 - lowest / sample_rate))))
    return noise_variance_above(lowest, [rows], 1.0 / sample_rate, window)


def _lowest_load_free_frequency(acquisition: Acquisition, nyquist: float) -> float:
    cutoff = acquisition.filter.cutoff if acquisition.filter else np.inf
    return float(min(LOAD_FREE_CUTOFF_FACTOR * cutoff, LOAD_FREE_NYQUIST_SHARE * nyquist))
