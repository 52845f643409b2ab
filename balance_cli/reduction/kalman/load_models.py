"""Load models: prior models of the loads as linear systems driven by white noise.

x' = A x + noise of intensity W, u = U x:

- `LowPassDrift`: u' = b (v - u), v' = -a v + noise, a load that drifts and steps;
- `BandLimitedNoise`: white within a band, a load that fluctuates; with a large variance it assumes as little as joint
  estimation of inputs and states;
- `FirstOrderMarkov`: u' = -a u + noise, a load that fluctuates without a band limit, as in turbulence;
- `Oscillators`: harmonics n of the rotor, p' = n Omega q + noise, q' = -n Omega p + noise, u = sum of p, so that at
  azimuth psi p = alpha cos n psi + beta sin n psi with drifting amplitudes alpha, beta.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from balance_cli.signals.anti_alias import butterworth_poles

Array = NDArray[np.float64]

LOW_PASS_ORDER = 6
"""Order of the Butterworth low-pass that limits a band: 36 dB per octave, at six states for each component."""
FORGETTING_RATE = 0.01
"""Decay rate [1/s] of the stationary amplitudes of the prior: slow compared with a record of seconds to minutes."""


class LoadLayer(Protocol):
    """A term of the loads (m,), independent in each component."""

    @property
    def sigma(self) -> Array:
        """Standard deviation (m,) of each component."""
        ...

    def matrices(self) -> tuple[Array, Array, Array]:
        """Return A, W (n, n) and U (m, n)."""
        ...

    def spectrum(self, frequency: Array) -> Array:
        """Return the two-sided spectral density (k, m) at frequencies (k,) [Hz]."""
        ...


@dataclass(frozen=True)
class LowPassDrift:
    """Loads of standard deviation `sigma` (m,): white noise through low-passes at two corner frequencies [Hz].

    The low-pass at `smoothing_corner` removes the loads at frequencies at which nothing can be measured.
    """

    sigma: Array
    corner: float
    smoothing_corner: float

    @property
    def _rates(self) -> tuple[float, float]:
        return 2 * np.pi * self.corner, 2 * np.pi * self.smoothing_corner

    def matrices(self) -> tuple[Array, Array, Array]:
        """Return those of x = (u, v): u' = b (v - u), v' = -a v + noise."""
        (a, b), m = self._rates, len(self.sigma)
        A = np.kron(np.eye(m), np.array([[-b, b], [0.0, -a]]))
        W = np.kron(np.diag(2 * a * (a + b) / b * self.sigma**2), np.diag([0.0, 1.0]))
        return A, np.asarray(W, float), np.kron(np.eye(m), np.array([[1.0, 0.0]]))

    def spectrum(self, frequency: Array) -> Array:
        """Return S(f) = 2 a b (a + b) sigma^2 / ((a^2 + w^2) (b^2 + w^2))."""
        (a, b), w = self._rates, 2 * np.pi * np.asarray(frequency, float)
        density = 2 * a * b * (a + b) / ((a**2 + w**2) * (b**2 + w**2))
        return np.asarray(density[:, None] * self.sigma**2)


@dataclass(frozen=True)
class BandLimitedNoise:
    """Loads of standard deviation `sigma` (m,), white up to `band` [Hz], by a Butterworth low-pass."""

    sigma: Array
    band: float

    @property
    def _noise_bandwidth(self) -> float:
        """Integral of 1 / (1 + (f / band)^(2 n)) df over positive and negative frequencies."""
        half = np.pi / (2 * LOW_PASS_ORDER)
        return float(2 * self.band * half / np.sin(half))

    def matrices(self) -> tuple[Array, Array, Array]:
        """Return those of x = (u, u' / w, u'' / w^2 ..), w = 2 pi band; white noise drives the last state."""
        w, m = 2 * np.pi * self.band, len(self.sigma)
        coefficients = np.real(np.poly(butterworth_poles(LOW_PASS_ORDER)))
        A = np.diag(np.ones(LOW_PASS_ORDER - 1), 1)
        A[-1] = -coefficients[:0:-1]
        density = self.sigma**2 / self._noise_bandwidth
        last = np.zeros(LOW_PASS_ORDER)
        last[-1] = 1.0
        W = np.kron(np.diag(density * w**2), np.outer(last, last))
        U = np.kron(np.eye(m), np.eye(LOW_PASS_ORDER)[:1])
        A_all = np.kron(np.eye(m), w * A)
        return np.asarray(A_all, np.float64), np.asarray(W, np.float64), np.asarray(U, np.float64)

    def spectrum(self, frequency: Array) -> Array:
        """Return S(f), proportional to 1 / (1 + (f / band)^(2 n))."""
        attenuation = 1.0 + (np.asarray(frequency, float) / self.band) ** (2 * LOW_PASS_ORDER)
        density = 1.0 / attenuation / self._noise_bandwidth
        return np.asarray(density[:, None] * self.sigma**2)


@dataclass(frozen=True)
class FirstOrderMarkov:
    """Loads of standard deviation `sigma` (m,), correlated exponentially: white noise through a pole at `corner` [Hz].

    The longitudinal gust of the Dryden turbulence model has this spectrum.
    """

    sigma: Array
    corner: float

    @property
    def _rate(self) -> float:
        return 2 * np.pi * self.corner

    def matrices(self) -> tuple[Array, Array, Array]:
        """Return those of x = u."""
        m = len(self.sigma)
        return -self._rate * np.eye(m), np.diag(2 * self._rate * self.sigma**2), np.eye(m)

    def spectrum(self, frequency: Array) -> Array:
        """Return S(f) = 2 a sigma^2 / (a^2 + w^2)."""
        density = 2 * self._rate / (self._rate**2 + (2 * np.pi * np.asarray(frequency, float)) ** 2)
        return np.asarray(density[:, None] * self.sigma**2)


@dataclass(frozen=True)
class Oscillators:
    """Harmonics `orders` (h,) of a rotor at `speed` [Hz], whose amplitudes drift.

    `drift` (h, m): standard deviation of the change of cosine and sine in one second; `size` (h, m): their standard
    deviation; `decay` [1/s]: rate of their return to zero. States: for each component, harmonic after harmonic, the
    pair (p, q).
    """

    drift: Array
    size: Array
    orders: tuple[int, ...]
    speed: float = 0.0
    decay: float = 0.0

    @property
    def sigma(self) -> Array:
        """Standard deviation (m,) of each component, all harmonics together."""
        return np.asarray(np.sqrt(np.sum(self.size**2, axis=0)))

    def with_stationary_drift(self) -> Oscillators:
        """Return oscillators of the same size whose drift keeps it stationary: the prior before any sample."""
        return replace(self, drift=np.sqrt(2 * FORGETTING_RATE) * self.size, decay=FORGETTING_RATE)

    def at(self, speed: float) -> Oscillators:
        """Return the oscillators at another speed [Hz]."""
        return replace(self, speed=speed)

    def matrices(self) -> tuple[Array, Array, Array]:
        """Return those of the pairs."""
        rotation, identity = np.array([[0.0, 1.0], [-1.0, 0.0]]), np.eye(2)
        h, m = self.drift.shape
        rates = 2 * np.pi * self.speed * np.array(self.orders)
        blocks = [rates[i] * rotation - self.decay * identity for _ in range(m) for i in range(h)]
        W = np.diag(np.repeat(self.drift.T.ravel() ** 2, 2))
        U = np.kron(np.eye(m), np.tile([1.0, 0.0], h)[None, :])
        return np.asarray(scipy.linalg.block_diag(*blocks), float), W, U

    def spectrum(self, frequency: Array) -> Array:
        """Return zeros: slowly drifting amplitudes have no density between the harmonics."""
        return np.zeros((len(np.asarray(frequency)), self.drift.shape[1]))


def combine_layers(layers: Sequence[LoadLayer]) -> tuple[Array, Array, Array]:
    """Return A, W and U of the sum of all layers; the states are those of the layers in turn."""
    parts = [layer.matrices() for layer in layers]
    A = scipy.linalg.block_diag(*(part[0] for part in parts))
    W = scipy.linalg.block_diag(*(part[1] for part in parts))
    return np.asarray(A, float), np.asarray(W, float), np.hstack([part[2] for part in parts])
