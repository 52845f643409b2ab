"""Whether the innovations of a filter are what it takes them for: of the size that it states, and white.

With e[k] in units in which its covariance should be one, the mean of e' e / c (normalised innovation squared, NIS) is
one, and the mean of N rho_l^2 over lags l and channels too, rho_l being the autocorrelations (Bar-Shalom, Li and
Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4; Box and Pierce, J. Am. Stat.
Assoc. 65, 1970, 1509).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LAGS = 20


@dataclass(frozen=True)
class InnovationTests:
    """NIS per channel and sample, and `whiteness` (1: white), each with the standard deviation that chance gives it.

    `channels` {name: its own mean square}: in units of what the channels before it in order leave open.
    """

    nis: float
    nis_sigma: float
    whiteness: float
    whiteness_sigma: float
    channels: dict[str, float]
    samples: int


@dataclass
class InnovationSums:
    """What blocks of innovations (n, c) add up to."""

    channels: int
    samples: int = 0
    squares: Array = field(default_factory=lambda: np.zeros(0))
    products: Array = field(default_factory=lambda: np.zeros((0, 0)))
    pairs: Array = field(default_factory=lambda: np.zeros(0))

    def add(self, innovations: Array) -> None:
        """One block; products reach within it only."""
        if not self.samples:
            self.squares, self.pairs = np.zeros(self.channels), np.zeros(LAGS)
            self.products = np.zeros((LAGS, self.channels))
        self.samples += len(innovations)
        self.squares += np.sum(innovations**2, axis=0)
        for lag in range(1, min(LAGS, len(innovations) - 1) + 1):
            self.products[lag - 1] += np.sum(innovations[lag:] * innovations[:-lag], axis=0)
            self.pairs[lag - 1] += len(innovations) - lag

    def tests(self, names: tuple[str, ...]) -> InnovationTests | None:
        """The tests; None where nothing was added."""
        if self.samples <= LAGS:
            return None
        mean = self.squares / self.samples
        rho = self.products / np.maximum(self.pairs, 1.0)[:, None] / mean
        return InnovationTests(
            nis=float(mean.mean()),
            nis_sigma=float(np.sqrt(2.0 / (self.samples * self.channels))),
            whiteness=float(np.mean(self.pairs[:, None] * rho**2)),
            whiteness_sigma=float(np.sqrt(2.0 / (LAGS * self.channels))),
            channels=dict(zip(names, mean.tolist(), strict=True)),
            samples=self.samples,
        )
