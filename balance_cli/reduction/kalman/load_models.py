"""What is known of the loads before they are measured: random, free within a band, or turning with the rotor.

Each is a linear system driven by white noise, x' = A x + noise of intensity W, u = U x:

- `LowPassDrift`: u' = b (v - u), v' = -a v + noise, a load that drifts and steps;
- `BandLimitedNoise`: white within a band, a load that fluctuates; large, it is all that joint estimation of inputs and
states says;
- `FirstOrderMarkov`: u' = -a u + noise, a load that fluctuates and has no band, as in turbulence;
- `Oscillators`: harmonics n of the rotor, p' = n Omega q + noise, q' = -n Omega p + noise, u = sum of p, so that at
  azimuth psi p = alpha cos n psi + beta sin n psi with amplitudes alpha, beta that drift.
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
"""Order of the low-pass that ends a flat band."""
FORGETTING_RATE = 0.01
"""Rate [1/s] at which amplitudes forget where only their size matters."""


class LoadLayer(Protocol):
    """A part of the loads (m,), each component by itself."""

    @property
    def sigma(self) -> Array:
        """Size (m,) of each component."""
        ...

    def matrices(self) -> tuple[Array, Array, Array]:
        """A, W (n, n) and U (m, n)."""
        ...

    def spectrum(self, frequency: Array) -> Array:
        """Density (k, m) over frequency (k,) [Hz], both signs of frequency counted."""
        ...


@dataclass(frozen=True)
class LowPassDrift:
    """Loads of standard deviation `sigma` (m,): white noise through low-passes at `corner` and `smooth` [Hz].

    The second keeps them out of frequencies at which nothing can be measured.
    """

    sigma: Array
    corner: float
    smoothing_corner: float

    @property
    def _rates(self) -> tuple[float, float]:
        return 2 * np.pi * self.corner, 2 * np.pi * self.smoothing_corner

    def matrices(self) -> tuple[Array, Array, Array]:
        """Of x = (u, v): u' = b (v - u), v' = -a v + noise."""
        (a, b), m = self._rates, len(self.sigma)
        A = np.kron(np.eye(m), np.array([[-b, b], [0.0, -a]]))
        W = np.kron(np.diag(2 * a * (a + b) / b * self.sigma**2), np.diag([0.0, 1.0]))
        return A, np.asarray(W, float), np.kron(np.eye(m), np.array([[1.0, 0.0]]))

    def spectrum(self, frequency: Array) -> Array:
        """S(f) = 2 a b (a + b) sigma^2 / ((a^2 + w^2) (b^2 + w^2))."""
        (a, b), w = self._rates, 2 * np.pi * np.asarray(frequency, float)
        density = 2 * a * b * (a + b) / ((a**2 + w**2) * (b**2 + w**2))
        return np.asarray(density[:, None] * self.sigma**2)


@dataclass(frozen=True)
class BandLimitedNoise:
    """Loads of standard deviation `sigma` (m,), white up to `band` [Hz]: white noise through a Butterworth low-pass."""

    sigma: Array
    band: float

    @property
    def _noise_bandwidth(self) -> float:
        """Int 1 / (1 + (f / band)^(2 n)) df over both signs of frequency."""
        half = np.pi / (2 * LOW_PASS_ORDER)
        return float(2 * self.band * half / np.sin(half))

    def matrices(self) -> tuple[Array, Array, Array]:
        """Of x = (u, u' / w, u'' / w^2 ..), w = 2 pi band: the last of them is driven by white noise."""
        w, m = 2 * np.pi * self.band, len(self.sigma)
        coefficients = np.real(np.poly(butterworth_poles(LOW_PASS_ORDER)))
        A = np.diag(np.ones(LOW_PASS_ORDER - 1), 1)
        A[-1] = -coefficients[:0:-1]
        density = self.sigma**2 / self._noise_bandwidth
        last = np.zeros(LOW_PASS_ORDER)
        last[-1] = 1.0
        W = np.kron(np.diag(density * w**2), np.outer(last, last))
        U = np.kron(np.eye(m), np.eye(LOW_PASS_ORDER)[:1])
        whole = np.kron(np.eye(m), w * A)
        return np.asarray(whole, np.float64), np.asarray(W, np.float64), np.asarray(U, np.float64)

    def spectrum(self, frequency: Array) -> Array:
        """S(f) proportional to 1 / (1 + (f / band)^(2 n))."""
        density = (
            1.0 / (1.0 + (np.asarray(frequency, float) / self.band) ** (2 * LOW_PASS_ORDER)) / self._noise_bandwidth
        )
        return np.asarray(density[:, None] * self.sigma**2)


@dataclass(frozen=True)
class FirstOrderMarkov:
    """Loads of standard deviation `sigma` (m,), correlated exponentially: white noise through a pole at `corner` [Hz].

    So is the gust along the wind in Dryden's turbulence.
    """

    sigma: Array
    corner: float

    @property
    def _rate(self) -> float:
        return 2 * np.pi * self.corner

    def matrices(self) -> tuple[Array, Array, Array]:
        """Of x = u."""
        m = len(self.sigma)
        return -self._rate * np.eye(m), np.diag(2 * self._rate * self.sigma**2), np.eye(m)

    def spectrum(self, frequency: Array) -> Array:
        """S(f) = 2 a sigma^2 / (a^2 + w^2)."""
        density = 2 * self._rate / (self._rate**2 + (2 * np.pi * np.asarray(frequency, float)) ** 2)
        return np.asarray(density[:, None] * self.sigma**2)


@dataclass(frozen=True)
class Oscillators:
    """Harmonics of a rotor at `speed` [Hz]: `drift` (h, m) standard deviation that cosine and sine of an amplitude gain

    in one second, `size` (h, m) that they have at all; they forget with `decay` [1/s]. `orders` (h,) of the harmonics.
    States: for each component, harmonic after harmonic, the pair (p, q).
    """

    drift: Array
    size: Array
    orders: tuple[int, ...]
    speed: float = 0.0
    decay: float = 0.0

    @property
    def sigma(self) -> Array:
        """Of each component (m,), all harmonics together."""
        return np.asarray(np.sqrt(np.sum(self.size**2, axis=0)))

    def with_stationary_drift(self) -> Oscillators:
        """Of the same size, but drifting so that they keep it: what is known before anything is measured."""
        return replace(self, drift=np.sqrt(2 * FORGETTING_RATE) * self.size, decay=FORGETTING_RATE)

    def at(self, speed: float) -> Oscillators:
        """The same at another speed [Hz]."""
        return replace(self, speed=speed)

    def matrices(self) -> tuple[Array, Array, Array]:
        """Of the pairs."""
        turn, keep = np.array([[0.0, 1.0], [-1.0, 0.0]]), np.eye(2)
        h, m = self.drift.shape
        order = 2 * np.pi * self.speed * np.array(self.orders)
        blocks = [order[i] * turn - self.decay * keep for _ in range(m) for i in range(h)]
        W = np.diag(np.repeat(self.drift.T.ravel() ** 2, 2))
        U = np.kron(np.eye(m), np.tile([1.0, 0.0], h)[None, :])
        return np.asarray(scipy.linalg.block_diag(*blocks), float), W, U

    def spectrum(self, frequency: Array) -> Array:
        """Of amplitudes that hardly move there is none between the harmonics."""
        return np.zeros((len(np.asarray(frequency)), self.drift.shape[1]))


def combine_layers(layers: Sequence[LoadLayer]) -> tuple[Array, Array, Array]:
    """A, W and U of the sum of all layers, their states in turn."""
    parts = [layer.matrices() for layer in layers]
    A = scipy.linalg.block_diag(*(part[0] for part in parts))
    W = scipy.linalg.block_diag(*(part[1] for part in parts))
    return np.asarray(A, float), np.asarray(W, float), np.hstack([part[2] for part in parts])
