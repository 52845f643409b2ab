"""What is known of the loads before they are measured: random, free within a band, or turning with the rotor.

Each is a linear system driven by white noise, x' = A x + noise of intensity W, u = U x:

- `GaussMarkov`: u' = -a u + noise with a = 2 pi corner, a load that wanders (low corner) or fluctuates (high corner);
- `Flat`: white within a band, all that joint estimation of inputs and states says of them;
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

Array = NDArray[np.float64]

SLOW = 0.01
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
class GaussMarkov:
    """Exponentially correlated loads of standard deviation `sigma` (m,), `corner` [Hz]."""

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
        """S(f) = 2 a sigma^2 / (a^2 + (2 pi f)^2)."""
        density = 2 * self._rate / (self._rate**2 + (2 * np.pi * np.asarray(frequency, float)) ** 2)
        return np.asarray(density[:, None] * self.sigma**2)


@dataclass(frozen=True)
class Flat:
    """Loads of standard deviation `sigma` (m,), white up to `band` [Hz] (a second-order Butterworth low-pass)."""

    sigma: Array
    band: float

    def matrices(self) -> tuple[Array, Array, Array]:
        """Of x = (u, u' / w), w = 2 pi band: u'' + sqrt(2) w u' + w^2 u is white."""
        w, m = 2 * np.pi * self.band, len(self.sigma)
        A = np.kron(np.eye(m), w * np.array([[0.0, 1.0], [-1.0, -np.sqrt(2.0)]]))
        W = np.kron(np.diag(2 * np.sqrt(2.0) * w * self.sigma**2), np.diag([0.0, 1.0]))
        U = np.kron(np.eye(m), np.array([[1.0, 0.0]]))
        return np.asarray(A, float), np.asarray(W, float), U

    def spectrum(self, frequency: Array) -> Array:
        """S(f) = 2 sqrt(2) sigma^2 / (w (1 + (f / band)^4))."""
        w = 2 * np.pi * self.band
        density = 2 * np.sqrt(2.0) / (w * (1.0 + (np.asarray(frequency, float) / self.band) ** 4))
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

    def stationary(self) -> Oscillators:
        """Of the same size, but drifting so that they keep it: what is known before anything is measured."""
        return replace(self, drift=np.sqrt(2 * SLOW) * self.size, decay=SLOW)

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


def joined(layers: Sequence[LoadLayer]) -> tuple[Array, Array, Array]:
    """A, W and U of the sum of all layers, their states in turn."""
    parts = [layer.matrices() for layer in layers]
    A = scipy.linalg.block_diag(*(part[0] for part in parts))
    W = scipy.linalg.block_diag(*(part[1] for part in parts))
    return np.asarray(A, float), np.asarray(W, float), np.hstack([part[2] for part in parts])
