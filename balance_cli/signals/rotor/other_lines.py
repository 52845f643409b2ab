"""Lines of a record that do not turn with its rotor: tones of known frequency, and modes that still ring.

Regressed together with the harmonics of the rotor they leak neither into these nor into the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LEAST_SEPARATION = 1.0
"""Cycles within the record by which two lines must differ to be told apart: the distance of two bins."""
STRIDE = 128
"""Samples of a block whose exponentials are products; its two factors together are a hundredth of the samples."""
FADED_TIME_CONSTANTS = 21.0
"""Time constants after which a decay is taken for zero: exp(-21) is 1e-9, far below the noise of any channel."""
UNEVEN = 1e-12
"""[s] by which even steps may differ: rounding of times below an hour; 1e-8 of a cycle at 10 kHz."""


@dataclass(frozen=True)
class OtherLines:
    """Tones at constant `frequencies` [Hz], and free decays exp(s (t - start)) from `start` [s] on, s [1/s].

    High-passes decay with real `rates` [1/s]: exp(-r (t - start)), less its mean over `duration` [s], so that the mean
    of a channel keeps its variance.
    """

    frequencies: tuple[float, ...] = ()
    exponents: tuple[complex, ...] = ()
    start: float = 0.0
    rates: tuple[float, ...] = ()
    duration: float = 0.0

    @property
    def columns(self) -> int:
        """The number of columns of the basis."""
        return 2 * (len(self.frequencies) + len(self.exponents)) + len(self.rates)

    def basis(self, time: Array) -> Array:
        """Return cosines and sines (columns, m) at `time` (m,) [s]; a decay has its first value before its start."""
        count, tones = len(self.exponents), len(self.frequencies)
        basis = np.empty((self.columns, len(time)))
        angle = 2.0 * np.pi * np.outer(self.frequencies, time)
        np.cos(angle, out=basis[:tones])
        np.sin(angle, out=basis[tones : 2 * tones])
        since_start, last = np.maximum(time - self.start, 0.0), 2 * (tones + count)
        decays = self._decays(since_start)
        basis[2 * tones : 2 * tones + count], basis[2 * tones + count : last] = decays.real, decays.imag
        for row, rate in zip(basis[last:], self.rates, strict=True):
            row[:] = np.exp(-rate * since_start) + np.expm1(-rate * self.duration) / (rate * self.duration)
        return basis

    def remaining(self, time: float) -> tuple[OtherLines, NDArray[np.int64]]:
        """Return the lines that have not faded at a time [s], and their columns of the basis."""
        tones, count = len(self.frequencies), len(self.exponents)
        rates = -np.array(self.exponents, complex).real
        kept = np.flatnonzero(rates * (time - self.start) < FADED_TIME_CONSTANTS)
        of_rates = 2 * (tones + count) + np.arange(len(self.rates))
        columns = np.concatenate([np.arange(2 * tones), 2 * tones + kept, 2 * tones + count + kept, of_rates])
        return replace(self, exponents=tuple(self.exponents[k] for k in kept)), columns

    def _decays(self, time: Array) -> ComplexArray:
        """Return exp(s t) (exponents, m) at ascending times (m,).

        At even steps each is the product of two, that of its block of STRIDE samples and that of its place there, which
        takes a tenth of the time of so many exponentials. Where the steps differ, each is computed.
        """
        s, blocks = np.array(self.exponents, complex), len(time) // STRIDE
        heads, even = time[: blocks * STRIDE : STRIDE], time[: blocks * STRIDE].reshape(-1, STRIDE)
        steps = even[-1] - even[-1, 0] if blocks else np.zeros(0)
        if not len(s) or not blocks or np.abs(even - heads[:, None] - steps).max() > UNEVEN:
            return np.asarray(np.exp(np.outer(s, time)))
        decays = np.empty((len(s), len(time)), complex)
        product = decays[:, : blocks * STRIDE].reshape(len(s), blocks, STRIDE)
        np.multiply(np.exp(np.outer(s, heads))[:, :, None], np.exp(np.outer(s, steps))[:, None, :], out=product)
        decays[:, blocks * STRIDE :] = np.exp(np.outer(s, time[blocks * STRIDE :]))
        return decays


NO_OTHER_LINES = OtherLines()


def tones_beside(frequency: float, frequencies: Sequence[float], duration: float, most: int) -> OtherLines:
    """Return those of the tones that are not multiples 1 to `most` of a frequency, within the resolution of a record.

    `duration` [s] of the record. The multiples are regressed already.
    """
    order = np.asarray(frequencies, float) / frequency
    nearest = np.round(order)
    apart = np.abs(order - nearest) * frequency * duration >= LEAST_SEPARATION
    return OtherLines(tuple(float(f) for f, keep in zip(frequencies, apart | (nearest > most), strict=True) if keep))
