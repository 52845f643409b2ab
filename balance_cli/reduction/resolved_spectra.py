"""Cross spectra of a record that are fine enough for the modes of the balance, for the spectra of loads.

The response is inverted at each frequency of the spectra, and has to be one number within their bandwidth: windows are
as long as the modes within the band need, and the loads are averaged over frequencies instead of windows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.channel_health import ChannelHealth
from balance_cli.campaign.recording.run import Run, pick_channels
from balance_cli.io.errors import UserError
from balance_cli.reduction.free_decays import rig_eigenvalues
from balance_cli.reduction.measured_response import highest_frequency
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.signals.cross_spectra import CrossSpectra, cross_spectra
from balance_cli.signals.run_samples import sample_rate

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

WINDOWS = 16
"""Windows end to end in a record; those that overlap make about 40 independent spectra, a random error of 16 %."""
FEWEST_BINS = 4
"""Frequencies in an average: fewer are hardly more than one, since neighbors within the bandwidth go together."""
BANDWIDTH_BINS = 2.0
"""Noise bandwidth of the Blackman-Harris window in bins (Harris, Proc. IEEE 66, 1978, 51)."""
STATISTICAL_BINS = 2.8
"""Statistical bandwidth of this window in bins: so many neighbors make one independent value (Bendat and Piersol,
Random Data, 4th ed., 8.5)."""
SPREAD_BINS = 0.787
"""Standard deviation in bins of the frequencies in one bin: rms slope of this window over its rms, over 2 pi."""
HALF_POWER_SHARE = 0.25
"""Of the half-power width of a mode, that the bandwidth has: the phase turns by 90 degrees across the former, and by an
eighth of a right angle from the middle of the bandwidth to either side."""
BELOW_NYQUIST = 0.9
"""Of half the sample rate: the highest frequency of a spectrum."""
MOST_BYTES = 2**28
"""Samples of a window in memory; beside them are their spectra."""


@dataclass(frozen=True)
class ResolvedSpectra:
    """Cross spectra within a band, of which `bins` neighbors are averaged; whether they resolve the modes within it.

    `decay` [s] is that of the slowest of these modes.
    """

    spectra: CrossSpectra
    bins: int
    is_resolved: bool
    decay: float = 0.0

    def average(self, values: Array) -> Array:
        """Return the means (k / bins, ...) over neighbors of values (k, ...); those left over are left out."""
        groups = len(self.spectra.frequency) // self.bins
        return np.asarray(values[: groups * self.bins].reshape(groups, self.bins, *values.shape[1:]).mean(axis=1))

    @property
    def averages(self) -> Array:
        """Independent spectra (k / bins,) in each average."""
        return self.average(self.spectra.averages) * max(self.bins / STATISTICAL_BINS, 1.0)

    @property
    def bandwidth(self) -> float:
        """Noise bandwidth [Hz] of an average."""
        return max(BANDWIDTH_BINS, self.bins) * float(np.min(np.diff(self.spectra.frequency), initial=np.inf))

    def spread(self, T: ComplexArray, density: ComplexArray) -> ComplexArray:
        """Return the covariance (k, r, r) of what T (k, r, m) differs by within the bandwidth, for random loads.

        The loads have the cross spectra `density` (k, m, m); the difference is that of a straight line.
        """
        step = float(np.min(np.diff(self.spectra.frequency)))
        slope = SPREAD_BINS * np.gradient(T, axis=0) * (step / np.gradient(self.spectra.frequency))[:, None, None]
        return np.asarray(slope @ density @ slope.conj().swapaxes(1, 2))


def resolved_spectra(
    run: Run, source: ResponseSource, health: ChannelHealth, first: int, band: tuple[float, float]
) -> ResolvedSpectra:
    """Return the cross spectra of the live channels from a sample on, and behind them of the loads the run has.

    Raises UserError where the record is too short, or the band holds fewer than two of its frequencies.
    """
    rate, samples = sample_rate(run), run.samples - first
    coarse = int(2 ** np.floor(np.log2(max(samples / WINDOWS, 2.0))))
    decay = _slowest_decay_within(run, source, band)
    needed = BANDWIDTH_BINS * rate * np.pi * decay / HALF_POWER_SHARE
    most = min(samples, MOST_BYTES // (8 * (len(health.live) + 6)))
    bins = int(min(np.ceil(needed / coarse), max(most // coarse, 1)))
    bins = 1 if needed <= coarse else max(bins, FEWEST_BINS)
    length = coarse * bins
    try:
        spectra = cross_spectra(_windows(run, health, first, length), 1.0 / rate, length, band=band)
    except UserError as error:
        raise _no_frequency_error(run, band, samples, rate / length) from error
    if len(spectra.frequency) < 2 * bins:
        raise _no_frequency_error(run, band, samples, bins * rate / length)
    return ResolvedSpectra(spectra, bins, BANDWIDTH_BINS * rate / length * np.pi * decay <= 1.0, decay)


def require_band(run: Run, source: ResponseSource, band: tuple[float, float]) -> None:
    """Raise UserError where the record or the response ends below the band."""
    highest = min(BELOW_NYQUIST * sample_rate(run) / 2.0, highest_frequency(source))
    if band[1] > highest:
        fault = f"{band[1]:g} Hz is beyond what the record and the response hold, {highest:.5g} Hz"
        raise UserError(fault, run.file, "--band", "Give a lower end")


def _slowest_decay_within(run: Run, source: ResponseSource, band: tuple[float, float]) -> float:
    """Time constant [s] of the slowest mode within a band; that of all, where no mode is known.

    Of a mode outside it is the inverse of its distance from the band in the plane of eigenvalues.
    """
    modes = rig_eigenvalues(source, run)
    if not len(modes):
        return source.slowest_decay
    frequency, (lowest, highest) = np.abs(modes.imag), 2.0 * np.pi * np.array(band)
    beyond = np.maximum(np.maximum(lowest - frequency, frequency - highest), 0.0)
    return float(np.max(1.0 / np.hypot(modes.real, beyond)))


def _windows(run: Run, health: ChannelHealth, first: int, length: int) -> Iterator[tuple[int, Array]]:
    """Yield windows (length, c or c + 6), each a third of its length after the one before."""
    for start in range(first, run.samples - length + 1, max(length // 3, 1)):
        block = run.read(start, start + length)
        channels = pick_channels(block.channels, run.channel_names, health.live)
        yield start, channels if block.loads is None else np.hstack([channels, block.loads])


def _no_frequency_error(run: Run, band: tuple[float, float], samples: int, step: float) -> UserError:
    if samples < WINDOWS * 2:
        return UserError("is too short for a spectrum", run.file, "channels", "Record for longer")
    fault = f"holds fewer than two of its frequencies, which are {step:.3g} Hz apart"
    return UserError(fault, run.file, f"--band {band[0]:g} {band[1]:g}", "Give a wider band, or record for longer")
