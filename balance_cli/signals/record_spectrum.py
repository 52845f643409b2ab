"""The spectrum of a whole record, which shows lines beside its harmonics and the noise of the channels above all loads.

It is in single precision, of channels relative to their largest value: the rounding is far below the noise of any
converter, and a transform takes half of the time.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run, read_channel_rows
from balance_cli.campaign.rig.geometry import Acquisition
from balance_cli.signals.amplitude_spectrum import fast_length, normalize_channels
from balance_cli.signals.channel_noise import row_noise

Array = NDArray[np.float64]
Singles = NDArray[np.float32]

LONGEST_RECORD = 65536
"""Samples that are examined at most, from the middle of the interval: a line of a minute is a line."""


@dataclass(frozen=True)
class RecordSpectrum:
    """Spectrum of c channels from sample `first` on: `power` (c, k) of a line, its squared amplitude, at `frequency`.

    `rows` (c, m) are the samples without their means, over `scale` (c,) [V]; powers are over the square of that.
    `frequency` (k,) [Hz].
    """

    names: tuple[str, ...]
    first: int
    sample_rate: float
    rows: Singles
    scale: Array
    frequency: Array
    power: Singles

    def noise_variance(self, acquisition: Acquisition) -> Array:
        """Return the noise variance (c,) [V2] of one sample of each channel, from frequencies above all loads."""
        return self.scale**2 * row_noise(self.rows, self.sample_rate, acquisition)


def record_spectrum(run: Run, names: tuple[str, ...], interval: tuple[float, float]) -> RecordSpectrum:
    """Return the spectrum of the named channels in an interval [s], or in the middle of a long one."""
    assert run.sample_rate is not None
    first, last = int(np.ceil(interval[0] * run.sample_rate)), int(interval[1] * run.sample_rate) + 1
    excess = max(0, last - first - LONGEST_RECORD) // 2
    first, last = first + excess, min(last - excess, run.samples)
    rows, scale = normalize_channels(read_channel_rows(run, names, first, last))
    frequency, power = line_powers(rows, run.sample_rate)
    return RecordSpectrum(names, first, run.sample_rate, rows, scale, frequency, power)


def line_powers(rows: Singles, rate: float) -> tuple[Array, Singles]:
    """Return frequencies (k,) and the squared amplitudes (c, k) of lines of rows (c, m) sampled at a rate.

    The window is Blackman's, whose side lobes lie 58 dB down. The last samples are left out where their number has a
    large prime factor.
    """
    from scipy.fft import rfft

    samples = fast_length(rows.shape[1])
    window = _blackman(samples)
    spectrum = rfft(rows[:, :samples] * (window * np.float32(2.0 / window.sum(dtype=np.float64))), axis=1)
    power = np.square(spectrum.real)
    power += np.square(spectrum.imag)
    return np.asarray(np.fft.rfftfreq(samples, 1.0 / rate)), power


@functools.lru_cache(maxsize=4)
def _blackman(samples: int) -> Singles:
    """Return the window; the runs of a batch have few lengths."""
    return np.asarray(np.blackman(samples), np.float32)
