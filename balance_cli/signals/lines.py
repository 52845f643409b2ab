"""What the signal steps hand on: spectra of a run at its lines, and frequency responses with their covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Window:
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


@dataclass(frozen=True)
class Lines:
    """Spectra of one run (or one experiment of it) at k lines: c channels, u excited load components.

    Amplitudes are complex, `x(t) = Re sum X exp(+j 2 pi f t)`. The noise of the stacked vector z = [channels, loads]
    is circular with covariance E[z z*] = `covariance` per line, that of the means as given (not of one period), and
    was estimated with `dof` complex degrees of freedom (infinite where it is known).
    `window`: where in a periodic record they come from; None where no free motion can be in them.

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
    window: Window | None = None


@dataclass(frozen=True)
class StaticPoints:
    """Load points of one static run: m rows of c channels [V] and the six loads [N, N m], in the order of loading.

    `covariance` (c, c) is the noise of a row's `channels - C0 loads` (so it holds the load readings' noise too),
    measured from second differences along the loading sequence and not from the residual of a fit.
    """

    run: str
    trim: str
    channel_names: tuple[str, ...]
    channels: Array
    loads: Array
    covariance: Array
    dof: float


@dataclass(frozen=True)
class Response:
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
