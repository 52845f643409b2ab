"""Lines of a record that do not turn with its rotor: harmonics of a second rotor, and tones of known frequency.

Regressed together with the harmonics of the rotor they leak neither into these nor into the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.rotor.azimuth import Azimuth

Array = NDArray[np.float64]

LEAST_SEPARATION = 1.0
"""Cycles within the record by which two lines must differ to be told apart: the distance of two bins."""


@dataclass(frozen=True)
class OtherLines:
    """Tones at `frequencies` [Hz] of constant speed, and the harmonics `orders` of a second rotor at `azimuth`."""

    frequencies: tuple[float, ...] = ()
    azimuth: Azimuth | None = None
    orders: tuple[int, ...] = ()

    @property
    def columns(self) -> int:
        """The number of columns of the basis."""
        return 2 * (len(self.frequencies) + (len(self.orders) if self.azimuth else 0))

    def basis(self, time: Array) -> Array:
        """Return cosines and sines (m, columns) at `time` (m,) [s]; zero outside the second rotor's pulses."""
        phase = [2.0 * np.pi * np.outer(time, self.frequencies)]
        if self.azimuth is not None:
            phase.append(np.outer(self.azimuth.psi(time), self.orders))
        angle = np.concatenate(phase, axis=1)
        return np.asarray(np.nan_to_num(np.hstack([np.cos(angle), np.sin(angle)])))


NO_OTHER_LINES = OtherLines()


def tones_beside(frequency: float, frequencies: Sequence[float], duration: float, most: int) -> OtherLines:
    """Return those of the tones that are not multiples 1 to `most` of a frequency, within the resolution of a record.

    `duration` [s] of the record. The multiples are regressed already.
    """
    order = np.asarray(frequencies, float) / frequency
    nearest = np.round(order)
    apart = np.abs(order - nearest) * frequency * duration >= LEAST_SEPARATION
    return OtherLines(tuple(float(f) for f, keep in zip(frequencies, apart | (nearest > most), strict=True) if keep))


def harmonics_of_second_rotor(
    azimuth: Azimuth, second: Azimuth, most: int, highest: float
) -> tuple[OtherLines, tuple[tuple[int, int], ...]]:
    """Return the harmonics of a second rotor up to `highest` [Hz] that differ from those of the first up to `most`.

    The second value lists the pairs (harmonic of the first, harmonic of the second) that cannot be told apart.
    """
    duration, ratio = azimuth.last - azimuth.first, second.mean_rate / azimuth.mean_rate
    orders, common = [], []
    for k in range(1, int(highest / second.mean_rate) + 1):
        nearest = round(k * ratio)
        if 1 <= nearest <= most and abs(k * ratio - nearest) * azimuth.mean_rate * duration < LEAST_SEPARATION:
            common.append((nearest, k))
        else:
            orders.append(k)
    return OtherLines((), second, tuple(orders)), tuple(common)
