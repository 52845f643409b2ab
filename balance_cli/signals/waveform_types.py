"""The channels of a run through time, from which forces that are not linear in the channels are computed.

A waveform is known at *bins*, and the spectral lines of its run follow from these. `SampledWaveform` (the mean period
of a periodic record) and `StaticWaveform` (load points) have lines that are the bins; the lines of a `RecordWaveform`
(a record that does not repeat) are weighted sums of neighboring bins.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class AnalysisWindow:
    """The samples from which each of k lines was computed: whole periods of the record, without a taper.

    `start` (k,) and `stop` [s] from the first sample, `step` [s] between samples. `covariance` (k, c+u, c+u) and `dof`
    are those of the noise alone, for estimators that model the transient that is still in the lines; the covariance of
    the lines themselves includes the scatter of the transient.
    """

    start: Array
    stop: float
    step: float
    covariance: ComplexArray
    dof: float

    def select(self, mask: Mask) -> AnalysisWindow:
        """The window of the lines (k,) in the mask."""
        return replace(self, start=self.start[mask], covariance=self.covariance[mask])


@dataclass(frozen=True)
class BinSampling:
    """How each of R bins was sampled: `count` (R,) samples from `start` (R,) [s] on, `step` [s] apart.

    `frequency` (R,) [Hz]; `tone_weight` (R,) is zero for a bin that a steady tone does not reach. `used` (U,) [Hz] are
    the bins that enter a line: those of a record are known farther.
    """

    frequency: Array
    start: Array
    step: float
    count: NDArray[np.intp]
    tone_weight: Array
    used: Array


class Waveform(Protocol):
    """The channels of a run through time: c channels at F frequencies, R bins, K spectral lines."""

    @property
    def volts(self) -> ComplexArray:
        """Amplitudes (F, c) [V] before the anti-alias filter."""
        ...

    @property
    def share(self) -> Array:
        """Weight (F, c) of each channel among those of its spring; zero where the filter leaves nothing to measure."""
        ...

    @property
    def noise(self) -> Array | None:
        """Standard deviation (c,) [V] of an amplitude by noise, as recorded; None where it is not known."""
        ...

    @property
    def frequency(self) -> Array:
        """Frequencies (F,) [Hz] of the amplitudes."""
        ...

    @property
    def fine_frequency(self) -> Array:
        """Frequencies (G,) [Hz] of the amplitudes of a function of the channels, the first F those of the channels."""
        ...

    @property
    def is_periodic(self) -> bool:
        """Whether the waveform repeats forever; if not, the rig was unloaded before it began."""
        ...

    @property
    def lines_are_bin_sums(self) -> bool:
        """Whether the lines are weighted sums of the bins, as for a record that does not repeat, or the bins."""
        ...

    @property
    def mean_factor(self) -> float:
        """Amplitude at frequency zero per unit of the mean."""
        ...

    @property
    def mean_window(self) -> AnalysisWindow | None:
        """The samples of the mean, where the mean is the only line with a transient in it; else None."""
        ...

    def select(self, mask: Mask) -> Waveform:
        """The waveform for the lines (K,) in the mask."""
        ...

    def with_channels(self, volts: ComplexArray, share: Array, noise: Array | None) -> Waveform:
        """The waveform with other channels, volts and share (F, c) and noise (c,)."""
        ...

    def draw_noise(self, rng: np.random.Generator) -> ComplexArray:
        """A sample (F, c) [V] of the errors of the amplitudes by noise; zero where it is not known."""
        ...

    def bin_sampling(self, frequency: Array, window: AnalysisWindow | None) -> BinSampling | None:
        """How the bins of lines at `frequency` (K,) [Hz] in a window were sampled; None without a time axis."""
        ...

    def filter_gain(self, frequency: float) -> float:
        """Magnitude of the anti-alias filter at the bin nearest to a frequency [Hz]."""
        ...

    def bin_frequency(self) -> Array:
        """Frequencies (R,) [Hz] of the bins."""
        ...

    def to_time_domain(self, amplitudes: ComplexArray, is_fine: bool = False) -> Array:
        """Amplitudes (F, ...), or (G, ...), as a function of time (n, ...); `is_fine`: for a function with kinks."""
        ...

    def differentiate(self, values: Array) -> Array:
        """The rate of change (n, ...) [1/s] of a function of time (n, ...)."""
        ...

    def to_amplitudes(self, values: Array) -> ComplexArray:
        """A function of time (n,) as amplitudes (G,)."""
        ...

    def to_bins(self, values: Array) -> ComplexArray:
        """A function of time (n, ...) at the bins (R, ...), after the anti-alias filter."""
        ...

    def combine_bins(self, values: ComplexArray) -> ComplexArray:
        """Values (R, ...) at the bins as lines (K, ...)."""
        ...

    def add_bins(self, total: ComplexArray, values: Callable[[Index], ComplexArray], at_once: int) -> None:
        """Add to `total` (K, ...), in place, the lines of `values` (r, ...) at r bins, so many at once.

        Bins that enter no line are not asked for.
        """
        ...

    def noise_spread(self, values: ComplexArray) -> float:
        """Variance of an inner product of lines with values (K,), both over their noise: one if the lines are apart."""
        ...


def add_bins_as_lines(total: ComplexArray, values: Callable[[Index], ComplexArray], at_once: int) -> None:
    """Add to `total` (K, ...), in place, `values` (r, ...) at r lines, so many at once; for bins that are the lines."""
    for start in range(0, len(total), at_once):
        lines = np.arange(start, min(start + at_once, len(total)))
        total[lines] += values(lines)
