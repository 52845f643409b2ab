"""What the signal steps hand on: spectra of a run at its lines, and frequency responses with their covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.waveform_types import AnalysisWindow, Waveform

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


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
    waveform: Waveform | None = None
    noise_parts: tuple[NoisePart, ...] = ()

    def select(self, keep: NDArray[np.bool_]) -> RunSpectrum:
        """Only the lines (k,) that are kept."""
        return replace(
            self,
            frequency=self.frequency[keep],
            channels=self.channels[keep],
            loads=self.loads[keep],
            covariance=self.covariance[keep],
            window=None if self.window is None else self.window.select(keep),
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
