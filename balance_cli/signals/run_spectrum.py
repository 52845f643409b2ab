"""Results of the signal processing: spectra of a run at its lines, and frequency responses, with covariance."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.waveform_types import AnalysisWindow, Waveform

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class NoisePart:
    """Component of the noise covariance of the channels, `size` * `share` (k,) * `shape` (c, c) at k lines or rows.

    `error` is the standard error of the size, which was estimated.
    """

    shape: Array
    share: Array
    size: float
    error: float

    @property
    def covariance(self) -> Array:
        """Covariance (k, c, c) at every line or row."""
        return np.asarray(self.size * self.share[:, None, None] * self.shape)

    def select(self, keep: NDArray[np.bool_]) -> NoisePart:
        """Return the part at the selected lines or rows (k,)."""
        return replace(self, share=self.share[keep])

    def project(self, projection: Array) -> NoisePart:
        """Return the part for l lines that are columns of a `projection` (k, l) of the rows.

        The lines are correlated where `share` differs between rows. To count as independent, each gets the sum of the
        magnitudes of its row of their covariance S: diag(sum_j |S_ij|) - S is diagonally dominant, and no information
        counts twice (Horn and Johnson, Matrix Analysis, 2nd ed. (2013), theorem 6.1.10).
        """
        covariance = projection.T @ (self.share[:, None] * projection)
        return replace(self, share=np.abs(covariance).sum(axis=1))


@dataclass(frozen=True)
class RecordDrift:
    """Changes of gain and delay [s] of c channels against the loads, from the first half of a record to the last.

    `change` (2, c) with `covariance` (2, c, c), estimated with `dof` complex degrees of freedom. `signal_to_noise` (c,)
    is the power of each channel over that of its noise, zero where noise would pass for a drift.
    """

    change: Array
    covariance: Array
    signal_to_noise: Array
    dof: float


@dataclass(frozen=True)
class RunSpectrum:
    """Spectra of one run (or one experiment of it) at k lines: c channels, u excited load components.

    Amplitudes are complex, `x(t) = Re sum X exp(+j 2 pi f t)`. The noise of the stacked vector z = [channels, loads]
    is circular with covariance E[z z*] = `covariance` per line, that of the means as given (not of one period), and
    was estimated with `dof` complex degrees of freedom (infinite where it is known).
    At frequency zero the amplitude is twice the mean, and the covariance twice the variance of that, as the noise is
    real; it is infinite where a channel has no information. `constant_volts` (k,) and `constant_loads` (k, u) are what
    an offset of one volt in every channel, or of one unit in every applied load, adds to the lines.
    `window` is the part of a periodic record from which the lines were taken; None where they contain no transient.
    `waveform` holds the channels in the time domain; None where it was not requested. `noise_parts` are the components
    of the noise of the channels, where these are not known equally well. `periods` (P, k, c) are the channels in each
    whole period of a periodic record; None where it does not repeat, and `drift` is that of its channels.

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
    periods: ComplexArray | None = None
    drift: RecordDrift | None = None

    def select(self, keep: NDArray[np.bool_]) -> RunSpectrum:
        """Return the spectrum at the selected lines (k,)."""
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
            periods=None if self.periods is None else self.periods[:, keep],
        )


@dataclass(frozen=True)
class StaticPoints:
    """Load points of one static run: m rows of c channels [V] and the six loads [N, N m], in the order of loading.

    `covariance` (c, c) is the noise of `channels - C0 loads` in a row, that of the load readings included; it is
    estimated from second differences along the load series and not from the residual of a fit.
    `share` (c,) is the weight of each channel among those of its spring, where forces are computed from them.
    `noise_parts`, with a share (m,) for each row, are its components, where the rows differ in noise. `series` (m,):
    number of the stated load series of each row, of which each has its own zero; None where the run states none.
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
    series: NDArray[np.intp] | None = None


@dataclass(frozen=True)
class FrequencyResponse:
    """Frequency response of one run, output/input with exp(+j omega t): k lines, c channels, u excited components.

    `response` (k, c, u) [V/N, V/(N m)]. Its covariance is separable: cov(vec) = `load_covariance` (k, u, u) kron
    `channel_covariance` (k, c, c), so that var(response[:, i, j]) = channel_covariance[:, i, i] *
    load_covariance[:, j, j]. `coherence` (k, c, u) is the ordinary coherence, with one input; `multiple_coherence`
    (k, c) is that with all inputs.

    `noise_dof`: complex degrees of freedom with which its covariance was estimated, infinite where it was stated.
    `line_share` (k,): share of each line that is independent of its neighbors, in the sense that as many lines as the
    shares add up to tell as much; None where all are independent. Artefacts of versions up to 0.1 have neither.
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
    noise_dof: float | None = field(default=None, metadata={"omit_if_none": True})
    line_share: Array | None = field(default=None, metadata={"omit_if_none": True})

    def select(self, keep: NDArray[np.bool_]) -> FrequencyResponse:
        """Return the response at the selected lines (k,)."""
        names = ("frequency", "response", "channel_covariance", "load_covariance", "coherence", "multiple_coherence")
        share = None if self.line_share is None else self.line_share[keep]
        return replace(self, **{name: getattr(self, name)[keep] for name in names}, line_share=share)

    @cached_property
    def window_models(self) -> dict[bytes, Any]:
        """The local models of its lines so far, by the indices of the lines, kept by `response.window_models`."""
        return {}
