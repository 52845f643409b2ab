"""The load points of a static run as a waveform without a time axis."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.waveform_types import AnalysisWindow, BinSampling, add_bins_as_lines

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class StaticWaveform:
    """The m load points of a static run: `volts` (m, c) and `share` (m, c), all at frequency zero.

    `projection` (K, m) transforms the values at the points into lines.
    """

    volts: ComplexArray
    share: Array
    projection: Array

    @property
    def noise(self) -> Array | None:
        """None: forces at rest hardly depend on it."""
        return None

    @property
    def frequency(self) -> Array:
        """Frequency [Hz] of the m points, zero."""
        return np.zeros(len(self.volts))

    @property
    def fine_frequency(self) -> Array:
        """Frequency [Hz] of the m points, zero."""
        return self.frequency

    @property
    def is_periodic(self) -> bool:
        """False: the first point follows the unloaded rig."""
        return False

    @property
    def lines_are_bin_sums(self) -> bool:
        """False: the bins are the lines."""
        return False

    @property
    def mean_factor(self) -> float:
        """1: the amplitude is the value of the point."""
        return 1.0

    @property
    def mean_window(self) -> AnalysisWindow | None:
        """None: load points hold no transient."""
        return None

    def select(self, mask: Mask) -> StaticWaveform:
        """The waveform for the lines (K,) in the mask."""
        return replace(self, projection=self.projection[mask])

    def with_channels(self, volts: ComplexArray, share: Array, noise: Array | None) -> StaticWaveform:
        """The waveform with other channels, volts and share (F, c)."""
        return replace(self, volts=volts, share=share)

    def draw_noise(self, rng: np.random.Generator) -> ComplexArray:
        """Zero (m, c): the noise of the points is not known here."""
        return np.zeros_like(self.volts)

    def bin_sampling(self, frequency: Array, window: AnalysisWindow | None) -> BinSampling | None:
        """None: load points have no time axis."""
        return None

    def filter_gain(self, frequency: float) -> float:
        """1: the filter passes constant voltages."""
        return 1.0

    def bin_frequency(self) -> Array:
        """Frequency [Hz] of the K bins, zero."""
        return np.zeros(len(self.projection))

    def to_time_domain(self, amplitudes: ComplexArray, is_fine: bool = False) -> Array:
        """The values (m, ...) at the points."""
        return np.asarray(amplitudes.real)

    def differentiate(self, values: Array) -> Array:
        """Zero (m, ...): the rig rests at the points."""
        return np.zeros_like(values)

    def to_amplitudes(self, values: Array) -> ComplexArray:
        """The values (m,) themselves."""
        return values.astype(complex)

    def to_bins(self, values: Array) -> ComplexArray:
        """Values (m, ...) at the points as lines (K, ...)."""
        return np.tensordot(self.projection, values, axes=1).astype(complex)

    def noise_spread(self, values: ComplexArray) -> float:
        """One: rows do not share any noise that a tone could have."""
        return 1.0

    def combine_bins(self, values: ComplexArray) -> ComplexArray:
        """The values (K, ...) themselves: the bins are the lines."""
        return values

    def add_bins(self, total: ComplexArray, values: Callable[[Index], ComplexArray], at_once: int) -> None:
        """Add the values (r, ...) themselves to `total` (K, ...): the bins are the lines."""
        add_bins_as_lines(total, values, at_once)
