"""Sums over the samples of a record that give the lines of its order spectrum on either side of each harmonic."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.rotor.harmonic_noise import INNERMOST_LINE

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LINE_BLOCK_SAMPLES = 1024
"""Samples whose products with all harmonics are formed at a time: 2 MB for 15 channels, which stay in the cache."""


def unit_powers(angle: Array, highest: int) -> ComplexArray:
    """Return exp(j k angle) (m, highest + 1) for k = 0 to `highest`, at least 1, from products of lower powers.

    This takes a tenth of the time of so many sines and cosines; the rounding error of a power is proportional to k.
    """
    powers = np.ones((len(angle), highest + 1), complex)
    powers[:, 1] = np.exp(1j * angle)
    known = 2
    while known <= highest:
        new = min(known - 1, highest + 1 - known)
        powers[:, known : known + new] = powers[:, 1 : new + 1] * powers[:, known - 1 : known]
        known += new
    return powers


def add_lines(lines: ComplexArray, step: Array, taper: Array, signals: Array, harmonics: Array) -> None:
    """Add samples to the `lines` (n + 1, 2 p, c) on either side of the harmonics, nearest in the middle.

    `step` (m,) is the angle between neighboring lines, `harmonics` (m, 2 n + 1) are the cosines and sines of the
    harmonics. Signals are real, so that the lines of either side are sums and differences of the same real products.
    """
    for part in np.array_split(np.arange(len(step)), max(1, len(step) // LINE_BLOCK_SAMPLES)):
        cut = slice(part[0], part[-1] + 1)
        _add_block(lines, step[cut], taper[cut], signals[cut], harmonics[cut])


def _add_block(lines: ComplexArray, step: Array, taper: Array, signals: Array, harmonics: Array) -> None:
    count, outermost = lines.shape[1] // 2, lines.shape[1] // 2 + INNERMOST_LINE - 1
    beside = unit_powers(step, outermost)[:, INNERMOST_LINE:] * taper[:, None]
    at_harmonics = (harmonics[:, :, None] * signals[:, None, :]).reshape(len(step), -1)
    shape = (count, harmonics.shape[1], signals.shape[1])
    cosine = (beside.real.T @ at_harmonics).reshape(shape).swapaxes(0, 1)
    sine = (beside.imag.T @ at_harmonics).reshape(shape).swapaxes(0, 1)
    n = len(lines) - 1
    zero = np.zeros_like(cosine[:1])
    cosine_sine, sine_sine = np.concatenate([zero, cosine[n + 1 :]]), np.concatenate([zero, sine[n + 1 :]])
    even, odd = cosine[: n + 1] - 1j * cosine_sine, sine_sine + 1j * sine[: n + 1]
    lines[:, count:] += even - odd
    lines[:, :count] += (even + odd)[:, ::-1]
