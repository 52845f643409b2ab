"""What the signal steps hand on: spectra of a run at its lines, and frequency responses with their covariance."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# A cube of a signal has three times its bandwidth; what a contact does has more.
OVERSAMPLING = 4


@dataclass(frozen=True)
class AnalysisWindow:
    """The samples that each of k lines was taken from: whole periods of the record, no taper.

    `start` (k,) and `stop` [s] from the first sample, `step` [s] between samples. `covariance` (k, c+u, c+u) and `dof`
    are those of the noise alone, for who models the free motion that still rings in the lines; what the lines state
    themselves holds its scatter too.
    """

    start: Array
    stop: float
    step: float
    covariance: ComplexArray
    dof: float


def hann_mean(values: Array) -> Array:
    """Mean (...) of values (n, ...), the ends of the record faded out."""
    n = len(values)
    return np.asarray(np.tensordot((1.0 - np.cos(2 * np.pi * np.arange(n) / n)) / n, values, axes=1))


@dataclass(frozen=True)
class Waveform:
    """Channels of a run through time, from which forces can be told that are no linear function of them.

    `volts` (F, c) and `share` (F, c): amplitudes before the anti-alias filter at `frequency` (F,) [Hz], the harmonics
    0, 1, 2 ... of 1/T, and the weight of each channel among those of its spring. A period T of `samples` samples recurs
    for ever. `number` (K,): which of the F a line is; `behind` (K,): the filter that it then has passed. Where it does
    not `recur`, it is all that there was.
    """

    frequency: Array
    volts: ComplexArray
    share: Array
    samples: int
    bin_index: NDArray[np.intp]
    filter_response: ComplexArray
    recurs: bool = True

    @property
    def step(self) -> float:
        """Time between samples [s]."""
        return 1.0 / (float(self.frequency[1]) * self.samples)

    def to_time_domain(self, amplitudes: ComplexArray) -> Array:
        """Amplitudes (F, ...) as a function of time (n, ...), finely sampled; at frequency zero twice the mean."""
        n = OVERSAMPLING * self.samples
        return np.asarray(np.fft.irfft(amplitudes * (n / 2.0), n, axis=0))

    def select(self, keep: NDArray[np.bool_]) -> Waveform:
        """For the lines (K,) that are kept."""
        return replace(self, bin_index=self.bin_index[keep], filter_response=self.filter_response[keep])

    def to_spectral_lines(self, force: Array) -> ComplexArray:
        """A function of time (n, ...) at the lines (K, ...), behind the anti-alias filter."""
        spectrum = np.fft.rfft(force, axis=0)[self.bin_index] * (2.0 / len(force))
        return np.asarray((spectrum.T * self.filter_response).T)


@dataclass(frozen=True)
class RecordWaveform(Waveform):
    """The waveform of a record that does not recur, whose lines are weighted sums of neighbouring ones of it.

    `number` and `behind` are those of the neighbours, R in all; a line is the sum over `weight` (K, M) times those from
    `first` (K,) on. The last neighbour is the mean, weighted by a Hann window.
    """

    first: NDArray[np.intp] = field(kw_only=True)
    weight: ComplexArray = field(kw_only=True)

    def select(self, keep: NDArray[np.bool_]) -> RecordWaveform:
        """For the lines (K,) that are kept."""
        return replace(self, first=self.first[keep], weight=self.weight[keep])

    def to_spectral_lines(self, force: Array) -> ComplexArray:
        """A function of time (n, ...) at the neighbours (R, ...), behind the anti-alias filter."""
        neighbours = super().to_spectral_lines(force)
        neighbours[-1] = 2.0 * hann_mean(force)
        return neighbours

    def combine_neighbors(self, values: ComplexArray) -> ComplexArray:
        """Values (R, ...) at the neighbours as lines (K, ...)."""
        from scipy.sparse import csr_array

        K, M = self.weight.shape
        neighbours = (self.first[:, None] + np.arange(M)).ravel()
        rows = csr_array((self.weight.ravel(), neighbours, np.arange(K + 1) * M), (K, len(values)))
        return np.asarray(rows @ values.reshape(len(values), -1)).reshape(K, *values.shape[1:])


@dataclass(frozen=True)
class StaticWaveform:
    """Channels of a static run point by point, as a waveform: `volts` (m, c) and `share` (m, c) at frequency zero.

    `projection` (K, m) takes a value at each point to the lines.
    """

    volts: ComplexArray
    share: Array
    projection: Array

    @property
    def frequency(self) -> Array:
        """Zero (m,) [Hz]."""
        return np.zeros(len(self.volts))

    @property
    def recurs(self) -> bool:
        """The first point follows on the unloaded rig."""
        return False

    def select(self, keep: NDArray[np.bool_]) -> StaticWaveform:
        """For the lines (K,) that are kept."""
        return replace(self, projection=self.projection[keep])

    def to_time_domain(self, amplitudes: ComplexArray) -> Array:
        """The points (m, ...) themselves."""
        return np.asarray(amplitudes.real)

    def to_spectral_lines(self, force: Array) -> ComplexArray:
        """Values at the points (m, ...) as lines (K, ...)."""
        return np.tensordot(self.projection, force, axes=1).astype(complex)


@dataclass(frozen=True)
class NoisePart:
    """A part of the channels' noise covariance, `size` * `share` (k,) * `shape` (c, c) at k lines or rows.

    `error`: standard error of the size, which was estimated.
    """

    shape: Array
    share: Array
    size: float
    error: float

    @property
    def covariance(self) -> Array:
        """At every line or row (k, c, c)."""
        return np.asarray(self.size * self.share[:, None, None] * self.shape)

    def select(self, keep: NDArray[np.bool_]) -> NoisePart:
        """At the lines or rows (k,) that are kept."""
        return replace(self, share=self.share[keep])

    def project(self, projection: Array) -> NoisePart:
        """That of lines which are columns of a `projection` (k, l) of the rows."""
        return replace(self, share=projection.T**2 @ self.share)


@dataclass(frozen=True)
class RunSpectrum:
    """Spectra of one run (or one experiment of it) at k lines: c channels, u excited load components.

    Amplitudes are complex, `x(t) = Re sum X exp(+j 2 pi f t)`. The noise of the stacked vector z = [channels, loads]
    is circular with covariance E[z z*] = `covariance` per line, that of the means as given (not of one period), and
    was estimated with `dof` complex degrees of freedom (infinite where it is known).
    `window`: where in a periodic record they come from; None where no free motion can be in them.
    At frequency zero the amplitude is twice the mean, and the covariance twice the variance of that, as the noise is
    real; it is infinite where a channel tells nothing. `constant_volts` (k,) and `constant_loads` (k, u): what one volt
    too much in every channel, one unit in every load that was applied, adds to the lines. `waveform`: the channels
    through time. None: nothing, or not asked for. `noise_parts`: what makes up the noise of the channels, where its
    parts are not known alike.

    Shapes: frequency (k,) [Hz]; channels (k, c) [V]; loads (k, u) [N, N m]; covariance (k, c+u, c+u).
    """

    run: str
    channel_names: tuple[str, ...]
    components: tuple[str, ...]
    frequency: Array
    channels: ComplexArray
    loads: ComplexArray
    covariance: ComplexArray
    dof: float
    rotor_speed: float = 0.0
    level: tuple[float, ...] = ()
    window: AnalysisWindow | None = None
    constant_volts: Array | None = None
    constant_loads: Array | None = None
    waveform: Waveform | StaticWaveform | None = None
    noise_parts: tuple[NoisePart, ...] = ()

    def select(self, keep: NDArray[np.bool_]) -> RunSpectrum:
        """Only the lines (k,) that are kept."""
        window = self.window
        if window is not None:
            window = replace(window, start=window.start[keep], covariance=window.covariance[keep])
        return replace(
            self,
            frequency=self.frequency[keep],
            channels=self.channels[keep],
            loads=self.loads[keep],
            covariance=self.covariance[keep],
            window=window,
            constant_volts=None if self.constant_volts is None else self.constant_volts[keep],
            constant_loads=None if self.constant_loads is None else self.constant_loads[keep],
            waveform=None if self.waveform is None else self.waveform.select(keep),
            noise_parts=tuple(part.select(keep) for part in self.noise_parts),
        )


@dataclass(frozen=True)
class StaticPoints:
    """Load points of one static run: m rows of c channels [V] and the six loads [N, N m], in the order of loading.

    `covariance` (c, c) is the noise of a row's `channels - C0 loads` (so it holds the load readings' noise too),
    measured from second differences along the loading sequence and not from the residual of a fit.
    `share` (c,): the weight of each channel among those of its spring, where forces are to be told from them.
    `noise_parts`, with a share (m,) for each row: what makes it up, where rows are not alike.
    """

    run: str
    trim: str
    channel_names: tuple[str, ...]
    channels: Array
    loads: Array
    covariance: Array
    dof: float
    share: Array | None = None
    noise_parts: tuple[NoisePart, ...] = ()


@dataclass(frozen=True)
class FrequencyResponse:
    """Frequency response of one run, output/input with exp(+j omega t): k lines, c channels, u excited components.

    `response` (k, c, u) [V/N, V/(N m)]. Its covariance is separable: cov(vec) = `load_covariance` (k, u, u) kron
    `channel_covariance` (k, c, c), so that var(response[:, i, j]) = channel_covariance[:, i, i] *
    load_covariance[:, j, j]. `coherence` (k, c, u) is ordinary (one input alone), `multiple_coherence` (k, c) of all.
    """

    run: str
    channel_names: tuple[str, ...]
    components: tuple[str, ...]
    estimator: str
    frequency: Array
    response: ComplexArray
    channel_covariance: ComplexArray
    load_covariance: ComplexArray
    coherence: Array
    multiple_coherence: Array
    rotor_speed: float = 0.0
    level: tuple[float, ...] = ()
