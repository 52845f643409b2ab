"""Tests of the innovations of a filter: of their covariance, and for whiteness.

With e[k] in units in which its covariance should be one, the mean of e' e / c (normalized innovation squared, NIS) is
one for a consistent filter, and so is the mean of N rho_l^2 over lags l and channels, where rho_l are the
autocorrelations (Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section
5.4; Box and Pierce, J. Am. Stat. Assoc. 65, 1970, 1509).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LAGS = 20
"""Lags of the whiteness test, the usual number for a Box-Pierce test of long series."""
SMALLEST_NIS, LARGEST_NIS = 0.8, 1.25
"""Normalized innovation squared of a filter whose sigma is right to within 12 %."""
LARGEST_AUTOCORRELATION = 0.15
"""Root-mean-square autocorrelation of the innovations, beyond chance, of a filter that follows its record.

A line that adds the share p to their variance makes it p/(1 + p)/sqrt(2), 0.14 at the limit of the NIS. It is up to
0.08 in records of six simulated rigs whose loads are right, probably as their fluctuation has another spectrum than the
load model. Unlike the whiteness statistic it does not grow with the length of the record.
"""
LARGEST_SLOW_POWER = 2.0
"""Spectral density of the innovations of a channel toward zero frequency, over that of white ones, where the filter
follows slow changes: up to 1.4 on records that it follows, 2.9 after a step of a load."""


@dataclass(frozen=True)
class InnovationTests:
    """NIS per channel and sample, and `whiteness` (1 if white), with their standard deviations for a consistent filter.

    `channels` {name: mean square of its innovations, in units of their variance given the channels before it}.
    `autocorrelation` {name: (LAGS,) of its innovations at lags from 1}, of so many `pairs` (LAGS,) of samples; None in
    artefacts that were written without them. `assumed_larger`: loads larger than those of the record were assumed, so
    that the innovations are smaller than the filter states; None where they were not.
    """

    nis: float
    nis_sigma: float
    whiteness: float
    whiteness_sigma: float
    channels: dict[str, float]
    samples: int
    autocorrelation: dict[str, Array] | None = field(default=None, metadata={"omit_if_none": True})
    pairs: Array | None = field(default=None, metadata={"omit_if_none": True})
    assumed_larger: bool | None = field(default=None, metadata={"omit_if_none": True})

    @property
    def rms_autocorrelation(self) -> float:
        """Root-mean-square autocorrelation, without that of white innovations in as many samples."""
        return float(np.sqrt(max(self.whiteness - 1.0, 0.0) / self.samples))

    @property
    def slow_power(self) -> float:
        """Largest spectral density of a channel toward zero frequency, over that of white innovations.

        From their autocorrelations with the window of Bartlett. One where these are not known.
        """
        rho = np.array(list((self.autocorrelation or {}).values()))
        if not rho.size:
            return 1.0
        window = 1.0 - np.arange(1, rho.shape[1] + 1) / (rho.shape[1] + 1)
        return float(np.max(1.0 + 2.0 * rho @ window))

    @property
    def least_nis(self) -> float:
        """NIS from which sigma is not too large without a reason."""
        return 0.0 if self.assumed_larger else SMALLEST_NIS

    @property
    def wrong_size(self) -> bool:
        """Whether the innovations are larger than the filter states, or smaller where nothing makes them so."""
        return not self.least_nis <= self.nis <= LARGEST_NIS

    @property
    def correlated(self) -> bool:
        """Whether the innovations predict each other: the filter does not follow the record."""
        return self.rms_autocorrelation > LARGEST_AUTOCORRELATION or self.slow_power > LARGEST_SLOW_POWER

    @property
    def contradict_filter(self) -> bool:
        """Whether the innovations are not of the size that the filter states, or not white."""
        return self.wrong_size or self.correlated


@dataclass
class InnovationSums:
    """Sums over blocks of innovations (n, c) of c `channels`."""

    channels: int
    samples: int = 0
    squares: Array = field(default_factory=lambda: np.zeros(0))
    products: Array = field(default_factory=lambda: np.zeros((0, 0)))
    pairs: Array = field(default_factory=lambda: np.zeros(0))

    def add(self, innovations: Array) -> None:
        """Add a block; products of different blocks are not counted."""
        if not self.samples:
            self.squares, self.pairs = np.zeros(self.channels), np.zeros(LAGS)
            self.products = np.zeros((LAGS, self.channels))
        self.samples += len(innovations)
        self.squares += np.sum(innovations**2, axis=0)
        for lag in range(1, min(LAGS, len(innovations) - 1) + 1):
            self.products[lag - 1] += np.sum(innovations[lag:] * innovations[:-lag], axis=0)
            self.pairs[lag - 1] += len(innovations) - lag

    def tests(self, names: tuple[str, ...], assumed_larger: bool = False) -> InnovationTests | None:
        """Return the tests; None where there are no more samples than lags."""
        if self.samples <= LAGS:
            return None
        mean_square = self.squares / self.samples
        rho = self.products / np.maximum(self.pairs, 1.0)[:, None] / mean_square
        return InnovationTests(
            nis=float(mean_square.mean()),
            nis_sigma=float(np.sqrt(2.0 / (self.samples * self.channels))),
            whiteness=float(np.mean(self.pairs[:, None] * rho**2)),
            whiteness_sigma=float(np.sqrt(2.0 / (LAGS * self.channels))),
            channels=dict(zip(names, mean_square.tolist(), strict=True)),
            samples=self.samples,
            autocorrelation=dict(zip(names, rho.T, strict=True)),
            pairs=self.pairs,
            assumed_larger=assumed_larger or None,
        )
