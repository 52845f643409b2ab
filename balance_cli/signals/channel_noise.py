"""The clean samples of a run, and the variance of the noise of its channels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run, read_channels
from balance_cli.campaign.rig.geometry import Acquisition
from balance_cli.signals.cross_spectra import MAIN_LOBE, cross_spectra, noise_variance

Array = NDArray[np.float64]

WINDOW_TIME = 1.28
"""Length [s] of a window in which the rotor's harmonics stand still enough to be kept apart from what lies between."""
LOAD_FREE_CUTOFF_FACTOR = 1.6
"""From this multiple of the anti-alias filter's cutoff on nothing but noise is left of a load."""
LOAD_FREE_NYQUIST_SHARE = 0.9
"""Share of half the sample rate above which lines count as quiet where no filter makes any so."""
BLOCK_SAMPLES = 32768


@dataclass(frozen=True)
class CleanRecord:
    """Samples start to stop of a run, all of its usable channels sound; `names` of these."""

    run: Run
    names: tuple[str, ...]
    spans: tuple[tuple[int, int], ...]

    @property
    def step(self) -> float:
        """Time [s] between samples."""
        assert self.run.sample_rate is not None
        return 1.0 / self.run.sample_rate

    def parts(self) -> Iterator[tuple[int, Array]]:
        """First sample and samples (n, c) of each block."""
        for start, stop in self.spans:
            for first in range(start, stop, BLOCK_SAMPLES):
                yield first, read_channels(self.run, self.names, first, min(first + BLOCK_SAMPLES, stop))

    def window(self, seconds: float) -> int:
        """Samples of a window about so long, a power of two, and at most a third of the longest span."""
        longest = max(stop - start for start, stop in self.spans)
        wanted = min(seconds / self.step, longest / 3)
        return int(2 ** np.round(np.log2(max(wanted, 4 * MAIN_LOBE))))


def channel_noise(clean_record: CleanRecord, acquisition: Acquisition) -> Array:
    """Variance (c,) [V2] of one sample of each channel's noise, from where no load reaches."""
    spectra = cross_spectra(clean_record.parts(), clean_record.step, clean_record.window(WINDOW_TIME))
    nyquist = 0.5 / clean_record.step
    cutoff = acquisition.filter.cutoff if acquisition.filter else np.inf
    load_free = spectra.frequency > (
        LOAD_FREE_CUTOFF_FACTOR * cutoff
        if LOAD_FREE_CUTOFF_FACTOR * cutoff < LOAD_FREE_NYQUIST_SHARE * nyquist
        else LOAD_FREE_NYQUIST_SHARE * nyquist
    )
    return noise_variance(spectra, clean_record.step, load_free)
