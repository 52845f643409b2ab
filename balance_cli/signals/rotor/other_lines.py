"""Lines of a record that do not turn with its rotor: tones of known frequency, and modes that still ring.

Regressed together with the harmonics of the rotor they leak neither into these nor into the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LEAST_SEPARATION = 1.0
"""Cycles within the record by which two lines must differ to be told apart: the distance of two bins."""


@dataclass(frozen=True)
class OtherLines:
    """Tones at constant `frequencies` [Hz], and free decays exp(s (t - start)) from `start` [s] on, s [1/s]."""

    frequencies: tuple[float, ...] = ()
    exponents: tuple[complex, ...] = ()
    start: float = 0.0

    @property
    def columns(self) -> int:
        """The number of columns of the basis."""
        return 2 * (len(self.frequencies) + len(self.exponents))

    def basis(self, time: Array) -> Array:
        """Return cosines and sines (m, columns) at `time` (m,) [s]; a decay has its first value before its start."""
        angle = 2.0 * np.pi * np.outer(time, self.frequencies)
        decays = np.exp(np.outer(np.maximum(time - self.start, 0.0), np.array(self.exponents, complex)))
        return np.hstack([np.cos(angle), np.sin(angle), decays.real, decays.imag])


NO_OTHER_LINES = OtherLines()


def tones_beside(frequency: float, frequencies: Sequence[float], duration: float, most: int) -> OtherLines:
    """Return those of the tones that are not multiples 1 to `most` of a frequency, within the resolution of a record.

    `duration` [s] of the record. The multiples are regressed already.
    """
    order = np.asarray(frequencies, float) / frequency
    nearest = np.round(order)
    apart = np.abs(order - nearest) * frequency * duration >= LEAST_SEPARATION
    return OtherLines(tuple(float(f) for f, keep in zip(frequencies, apart | (nearest > most), strict=True) if keep))
