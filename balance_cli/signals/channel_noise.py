"""The clean samples of a run, and the variance of the noise of its channels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run, read_channels
from balance_cli.campaign.rig.geometry import Acquisition
from balance_cli.signals.cross_spectra import MAIN_LOBE, cross_spectra, noise_of_channels

Array = NDArray[np.float64]

WINDOW = 1.28
"""Length [s] of a window in which the rotor's harmonics stand still enough to be kept apart from what lies between."""
QUIET = 1.6
"""From this multiple of the anti-alias filter's cutoff on nothing but noise is left of a load."""
TOP = 0.9
"""Share of half the sample rate above which lines count as quiet where no filter makes any so."""
BLOCK = 32768


@dataclass(frozen=True)
class Clean:
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
            for first in range(start, stop, BLOCK):
                yield first, read_channels(self.run, self.names, first, min(first + BLOCK, stop))

    def window(self, seconds: float) -> int:
        """Samples of a window about so long, a power of two, and at most a third of the longest span."""
        longest = max(stop - start for start, stop in self.spans)
        wanted = min(seconds / self.step, longest / 3)
        return int(2 ** np.round(np.log2(max(wanted, 4 * MAIN_LOBE))))


def channel_noise(clean: Clean, acquisition: Acquisition) -> Array:
    """Variance (c,) [V2] of one sample of each channel's noise, from where no load reaches."""
    spectra = cross_spectra(clean.parts(), clean.step, clean.window(WINDOW))
    nyquist = 0.5 / clean.step
    cutoff = acquisition.filter.cutoff if acquisition.filter else np.inf
    quiet = spectra.frequency > (QUIET * cutoff if QUIET * cutoff < TOP * nyquist else TOP * nyquist)
    return noise_of_channels(spectra, clean.step, quiet)
