"""Phases of a multisine with a small peak: in closed form, and improved by clipping."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]

SAMPLES_OF_HIGHEST_LINE = 16
"""Samples in a cycle of the highest line, on which the peak is sought: it is then found to 2 %."""
CLIPPING_LEVELS = (0.80, 0.85, 0.90, 0.93, 0.95, 0.97, 0.98, 0.99)
"""Clipping over the peak. Van der Ouderaa et al. begin with a low level and raise it, or the peak stays at a local
minimum soon."""
STEPS_OF_A_LEVEL = 60
"""Clippings at each level: of 50 to 600 lines, flat or in steps, the peak is then 1.39 to 1.57 times the rms."""


def schroeder_phases(power: Array) -> Array:
    """Phases (count,) [rad] of lines with this relative power (count,) and a small peak of their sum.

    -2 pi sum_{l<k} (k - l) p_l with sum p = 1; for equal lines -pi k (k - 1) / count, k = 1, 2 ... M. R. Schroeder,
    IEEE Trans. Inf. Theory 16 (1970) 85. The peak of the sum is less than twice its rms where the power varies little
    from line to line; that of random phases is three to four times.
    """
    share = power / power.sum()
    before = np.concatenate([[0.0], np.cumsum(np.cumsum(share))[:-1]])
    return np.asarray(-2.0 * np.pi * before)


def low_crest_phases(numbers: Index, power: Array) -> Array:
    """Phases (count,) [rad] of the lines of these numbers with a still smaller peak of the sum.

    The sum is clipped, the phases of the clipped one are taken, the amplitudes restored, and so on (E. van der Ouderaa,
    J. Schoukens and J. Renneboog, IEEE Trans. Instrum. Meas. 37 (1988) 207), from the phases of Schroeder. Same input,
    same phases.
    """
    return np.array(_low_crest_phases(tuple(numbers.tolist()), tuple(power.tolist())))


@lru_cache(maxsize=64)
def _low_crest_phases(numbers: tuple[int, ...], power: tuple[float, ...]) -> tuple[float, ...]:
    lines, amplitude = np.array(numbers), np.sqrt(np.array(power))
    best = phases = schroeder_phases(np.array(power))
    count = 2 ** int(np.ceil(np.log2(SAMPLES_OF_HIGHEST_LINE * lines[-1])))
    least = np.inf
    for level in CLIPPING_LEVELS:
        for _ in range(STEPS_OF_A_LEVEL):
            signal = _one_period(lines, amplitude * np.exp(1j * phases), count)
            peak = float(np.abs(signal).max())
            if peak < least:
                least, best = peak, phases
            clipped = np.clip(signal, -level * peak, level * peak)
            phases = np.angle(np.fft.rfft(clipped)[lines])
    return tuple(best.tolist())


def _one_period(lines: Index, amplitudes: NDArray[np.complex128], count: int) -> Array:
    spectrum = np.zeros(count // 2 + 1, complex)
    spectrum[lines] = 0.5 * count * amplitudes
    return np.fft.irfft(spectrum, count)


def crest_factor(numbers: Index, power: Array, phases: Array) -> float:
    """Peak over rms of the sum of lines of these numbers, power (count,) and phases (count,) [rad]."""
    count = 2 ** int(np.ceil(np.log2(SAMPLES_OF_HIGHEST_LINE * numbers[-1])))
    signal = _one_period(numbers, np.sqrt(power) * np.exp(1j * phases), count)
    return float(np.abs(signal).max() / np.sqrt(0.5 * power.sum()))
