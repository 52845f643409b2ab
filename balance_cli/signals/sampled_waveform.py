"""Waveforms with a time axis: the period of a periodic record, or a whole record that does not repeat."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.waveform_types import AnalysisWindow, BinSampling, add_bins_as_lines

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]

# The cube of a signal has three times its bandwidth. The force of a slipping contact has more: at four times the rate
# its turns and kinks left a residual of up to three times the noise beside a mode, at 16 times and beyond hardly any.
OVERSAMPLING, CONTACT_OVERSAMPLING = 4, 16


@lru_cache(maxsize=16)
def _fast_length(n: int) -> int:
    """The least number of instants from n on of which a Fourier transform is fast: a prime one takes ten times as long.

    Signals are band-limited, so that every number of instants in a record serves as well.
    """
    from scipy.fft import next_fast_len

    return int(next_fast_len(n, real=True))


def _by_function(values: NDArray[Any]) -> NDArray[Any]:
    """Values (F, ...) as (..., F), each function contiguous in memory: in time they are combined function by function.

    Interleaved, a product of a force and its derivatives took three to six times as long, a transform 1.5 times.
    """
    return np.ascontiguousarray(np.moveaxis(values, 0, -1))


def _at_instants(functions: Array) -> Array:
    """Functions of time (..., n) as (n, ...), where they are in memory."""
    return np.moveaxis(functions, -1, 0)


def hann_mean(values: Array) -> Array:
    """Mean (...) of values (n, ...) with the weights of a Hann window."""
    return np.asarray(np.tensordot(_hann_weights(len(values)), values, axes=1))


@lru_cache(maxsize=4)
def _hann_weights(n: int) -> Array:
    """The window (n,) over its sum; records of one campaign are of one length or two, sampled coarsely or finely."""
    return np.asarray((1.0 - np.cos(2 * np.pi * np.arange(n) / n)) / n)


def end_to_end_rise(samples: Array) -> Array:
    """By how much (...) samples (n, ...) rise from the first to one after the last: the values and slopes at the ends.

    Both are means that a signal at half the sample rate does not change: amplitudes do not contain it.
    """
    first, last = (0.25 * (part[0] + 2.0 * part[1] + part[2]) for part in (samples[:3], samples[-3:]))
    slopes = 0.5 * (samples[2] - samples[0]), 0.5 * (samples[-1] - samples[-3])
    return np.asarray(last - first + 1.5 * (slopes[0] + slopes[1]))


@dataclass(frozen=True, eq=False)
class SampledWaveform:
    """A waveform of `samples` samples whose bins are the lines.

    `volts` and `share` (F, c) are at the harmonics 0, 1, 2 ... of 1/T, `frequency` (F,) [Hz], of a period T.
    `bin_index` (R,) is the position of each bin among the F frequencies, `filter_response` (R,) the anti-alias filter
    there. `noise` (c,) [V]: standard deviation of an amplitude as recorded, `passed_share` (F,) what the filter passes;
    None where the noise is not known.
    """

    frequency: Array
    volts: ComplexArray
    share: Array
    samples: int
    bin_index: NDArray[np.intp]
    filter_response: ComplexArray
    is_periodic: bool = True
    noise: Array | None = None
    passed_share: Array | None = None

    @property
    def fine_frequency(self) -> Array:
        """Frequencies (G,) [Hz] up to half the rate of the oversampled waveform."""
        return np.asarray(self.frequency[1] * np.arange(OVERSAMPLING * self.samples // 2))

    @property
    def lines_are_bin_sums(self) -> bool:
        """False: the bins are the lines."""
        return False

    @property
    def step(self) -> float:
        """Time between samples [s]."""
        return 1.0 / (float(self.frequency[1]) * self.samples)

    @property
    def mean_factor(self) -> float:
        """2, as for every one-sided amplitude."""
        return 2.0

    @property
    def mean_window(self) -> AnalysisWindow | None:
        """None: the window of the run holds for all lines."""
        return None

    def select(self, mask: Mask) -> SampledWaveform:
        """The waveform for the lines (K,) in the mask."""
        return replace(self, bin_index=self.bin_index[mask], filter_response=self.filter_response[mask])

    def with_channels(self, volts: ComplexArray, share: Array, noise: Array | None) -> SampledWaveform:
        """The waveform with other channels, volts and share (F, c) and noise (c,)."""
        return replace(self, volts=volts, share=share, noise=noise)

    def draw_noise(self, rng: np.random.Generator) -> ComplexArray:
        """A sample (F, c) [V] of the errors of the amplitudes by noise; zero where it is not known, or an amplitude is.

        Of an amplitude that Wiener's gain g has reduced, an error of g times the variance of the noise is left; with
        the power q of the reduced one, sigma^2 / (1 - g) is P in q = (P - sigma^2)^2 / P.
        """
        if self.noise is None or self.passed_share is None:
            return np.zeros_like(self.volts)
        variance = self.noise**2
        q = np.abs(self.volts * self.passed_share[:, None]) ** 2
        power = variance + 0.5 * (q + np.sqrt(q * (q + 4.0 * variance)))
        error = np.sqrt(0.5 * variance * (1.0 - variance / np.maximum(power, np.finfo(float).tiny)))
        draw = rng.normal(size=(2, *error.shape)) * np.where(self.share > 0, error, 0.0)
        return np.asarray((draw[0] + 1j * draw[1]) / np.maximum(self.passed_share, np.finfo(float).tiny)[:, None])

    def bin_sampling(self, frequency: Array, window: AnalysisWindow | None) -> BinSampling:
        """The samples of the window; those of one period where no window is known."""
        start = np.zeros(len(frequency)) if window is None else window.start
        length = self.samples * self.step if window is None else window.stop - window.start
        count = np.broadcast_to(np.rint(length / self.step).astype(int), frequency.shape)
        return BinSampling(frequency, start, self.step, count, np.ones(len(frequency)), frequency)

    def filter_gain(self, frequency: float) -> float:
        """Magnitude of the anti-alias filter at the bin nearest to a frequency [Hz]."""
        return float(abs(self.filter_response[np.argmin(np.abs(self.bin_frequency() - frequency))]))

    def bin_frequency(self) -> Array:
        """Frequencies (R,) [Hz] of the bins."""
        return self.frequency[self.bin_index]

    def to_time_domain(self, amplitudes: ComplexArray, is_fine: bool = False) -> Array:
        """Amplitudes (F, ...), or (G, ...), in time (n, ...), oversampled; at frequency zero twice the mean."""
        n = _fast_length((CONTACT_OVERSAMPLING if is_fine else OVERSAMPLING) * self.samples)
        return _at_instants(np.fft.irfft(_by_function(amplitudes) * (n / 2.0), n))

    def differentiate(self, values: Array) -> Array:
        """The rate of change (n, ...) [1/s] of a function of time (n, ...), from its spectrum times i w.

        Where nothing repeats, the straight line from end to end is taken out first: the step between its ends would
        ring through the whole record. Of the samples it takes those at the ends alone, by their sums.
        """
        spectrum = np.moveaxis(np.fft.rfft(_by_function(values)), -1, 0)
        rates = 2j * np.pi * self.frequency[1] * np.arange(len(spectrum))
        slope = np.zeros(values.shape[1:])
        if not self.is_periodic:
            count, bins = len(self.frequency), np.arange(1, len(self.frequency))
            ends = np.array([0, 1, 2, -3, -2, -1])
            waves = np.exp(2j * np.pi / self.samples * np.outer(ends, bins))
            at_ends = (spectrum[0] + 2.0 * np.tensordot(waves, spectrum[1:count], 1)).real / len(values)
            rise = end_to_end_rise(at_ends)
            line = len(values) / self.samples / (np.exp(-2j * np.pi / self.samples * bins) - 1.0)
            spectrum[1:count] -= np.multiply.outer(line, rise)
            slope = rise * self.frequency[1]
        return _at_instants(np.fft.irfft(_by_function(spectrum) * rates, len(values))) + slope

    def to_amplitudes(self, values: Array) -> ComplexArray:
        """A function of time (n,) as amplitudes (G,), beyond those of the samples, too."""
        return np.asarray(np.fft.rfft(values)[: len(self.fine_frequency)] * (2.0 / len(values)))

    def to_bins(self, values: Array) -> ComplexArray:
        """A function of time (n, ...) at the bins (R, ...), after the anti-alias filter."""
        spectrum = np.fft.rfft(values, axis=0)[self.bin_index] * (2.0 / len(values))
        return np.asarray((spectrum.T * self.filter_response).T)

    def combine_bins(self, values: ComplexArray) -> ComplexArray:
        """The values (R, ...) themselves: the bins are the lines."""
        return values

    def add_bins(self, total: ComplexArray, values: Callable[[Index], ComplexArray], at_once: int) -> None:
        """Add the values (r, ...) themselves to `total` (R, ...): the bins are the lines."""
        add_bins_as_lines(total, values, at_once)

    def noise_spread(self, values: ComplexArray) -> float:
        """One: each line is a bin of its own."""
        return 1.0


@dataclass(frozen=True, eq=False)
class RecordWaveform(SampledWaveform):
    """The waveform of a record that does not repeat, whose lines are weighted sums of neighboring bins.

    A line is the sum of `weight` (K, M) times the M bins from `first` (K,) on. The last bin is the mean, taken with a
    Hann window.
    """

    first: NDArray[np.intp] = field(kw_only=True)
    weight: ComplexArray = field(kw_only=True)

    @property
    def lines_are_bin_sums(self) -> bool:
        """True: the lines are sums of bins."""
        return True

    @property
    def mean_window(self) -> AnalysisWindow | None:
        """The whole record: local models have removed the transient from all lines but the mean."""
        return AnalysisWindow(np.zeros(1), self.samples * self.step, self.step, np.zeros((1, 0, 0), complex), np.inf)

    def select(self, mask: Mask) -> RecordWaveform:
        """The waveform for the lines (K,) in the mask; the bins stay."""
        return replace(self, first=self.first[mask], weight=self.weight[mask])

    def bin_sampling(self, frequency: Array, window: AnalysisWindow | None) -> BinSampling:
        """All samples of the record for each bin; the Hann window keeps a tone out of the mean."""
        bins = self.bin_frequency()
        tone_weight = np.ones(len(bins))
        tone_weight[-1] = 0.0
        count = np.full(len(bins), self.samples)
        used = np.unique(self.first[frequency > 0, None] + np.arange(self.weight.shape[1]))
        return BinSampling(bins, np.zeros(len(bins)), self.step, count, tone_weight, bins[used])

    def to_bins(self, values: Array) -> ComplexArray:
        """A function of time (n, ...) at the bins (R, ...), after the anti-alias filter; the last is a Hann mean."""
        bins = super().to_bins(values)
        bins[-1] = 2.0 * hann_mean(values)
        return bins

    def combine_bins(self, values: ComplexArray) -> ComplexArray:
        """Values (R, ...) at the bins as lines (K, ...)."""
        rows = self._sums_of_bins
        return np.asarray(rows @ values.reshape(len(values), -1)).reshape(rows.shape[0], *values.shape[1:])

    def add_bins(self, total: ComplexArray, values: Callable[[Index], ComplexArray], at_once: int) -> None:
        """Add to `total` (K, ...) the lines of `values` (r, ...) at the bins that enter any, so many at once."""
        used = np.unique(self._sums_of_bins.indices).astype(np.intp)
        for start in range(0, len(used), at_once):
            bins = used[start : start + at_once]
            columns = self._sums_of_bins[:, bins]
            lines = np.flatnonzero(np.diff(columns.indptr))  # neighbors alone
            at_bins = values(bins)
            at_lines = np.asarray(columns[lines] @ at_bins.reshape(len(bins), -1))
            total[lines] += at_lines.reshape(len(lines), *at_bins.shape[1:])

    def noise_spread(self, values: ComplexArray) -> float:
        """More than one where lines share bins: the transient of a window is subtracted from all of its lines."""
        size = np.sqrt(np.sum(np.abs(self.weight) ** 2, axis=1))
        power = float(np.sum(np.abs(values) ** 2))
        at_bins = self._sums_of_bins.T @ (values.conj() / np.maximum(size, np.finfo(float).tiny))
        return float(np.sum(np.abs(at_bins) ** 2)) / power if power > 0.0 else 1.0

    @cached_property
    def _sums_of_bins(self) -> csr_array:
        """The matrix (K, R) from bins to lines."""
        from scipy.sparse import csr_array

        K, M = self.weight.shape
        neighbors = (self.first[:, None] + np.arange(M)).ravel()
        return csr_array((self.weight.ravel(), neighbors, np.arange(K + 1) * M), (K, len(self.bin_index)))
