"""Tones so near to a harmonic of the rotor that a spectrum shows one line for both.

Under a taper a harmonic of constant amplitude has the shape of the taper's own lobe. A tone at a distance of d bins,
which is not one of the rotor, leaves beside it the lobe of d. A load that steps or drifts leaves lines on both sides.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.rotor.harmonic_noise import AROUND, MEDIAN_OF_EXPONENTIAL, NoiseLines, blackman_taper

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

DISTANCES = np.concatenate([sign * np.arange(0.75, 4.01, 0.0625) for sign in (-1.0, 1.0)])
"""Distances [bins] that are tried. A tone down to half a bin has the lines of the nearest of them, to 3 %; nearer, it
looks like a load that drifts; beyond, it is a line of its own."""
UNEXPLAINED_SHARE = 0.03
"""Share of the power beside a harmonic, beyond that of noise, that one tone may leave: the nearest one leaves 14 % of a
ramp of the load, and more of other changes, which have lines on both sides."""
LEAST_TOTAL = 20.0
"""Power in the lines of all channels over that of noise at least, for that share to be told."""
TONE_TO_NOISE = 50.0
"""Power of a tone over that of noise at least: noise of a million independent lines reaches 40."""
FALSE_ALARM = 1e-7
"""Probability that noise of one channel, known from few lines, has such a power at one distance."""
LOBE_POINTS = 512
"""Points of the taper from which its lobe is computed."""


@dataclass(frozen=True)
class NearTones:
    """Tones (n,) beside harmonics 1 to n: distance [bins], and amplitude and power over noise (n, c) in c channels.

    `least_power` (n,) is that from which chance does not make it, by the F distribution of so many lines.
    """

    distance: Array
    amplitude: Array
    power: Array
    least_power: Array


def find_near_tones(lines: NoiseLines, columns: list[int]) -> NearTones:
    """Return the tone beside each harmonic that explains the lines of the channels best; zero where none does."""
    around, values = lines.around[:, :, columns], lines.values[:, :, columns]
    harmonic, tones, size = _lobes()
    power = np.where(lines.keep[:, :, None], np.abs(values) ** 2, np.nan)
    noise = np.nanmedian(power, axis=1) / MEDIAN_OF_EXPONENTIAL + np.finfo(float).tiny
    left = around - harmonic[:, None] * np.einsum("b,nbc->nc", harmonic.conj(), around)[:, None]
    fit = np.einsum("db,nbc->ndc", (tones / size[:, None]).conj(), left)
    explained = np.abs(fit) ** 2 / noise[:, None]
    whole = np.sum(np.abs(left) ** 2, axis=1) / noise
    best = np.argmax(explained.sum(axis=2), axis=1)
    at = np.arange(len(best)), best
    noise_power, total = around[0].size, whole.sum(axis=1)
    unexplained = total - explained[at].sum(axis=1) - noise_power
    clear = (unexplained <= UNEXPLAINED_SHARE * total) & (total > LEAST_TOTAL * noise_power)
    power = np.where(clear[:, None], explained[at], 0.0)
    amplitude = np.where(clear[:, None], np.abs(fit[at]) / size[best][:, None], 0.0)
    count = lines.keep.sum(axis=1)
    least = np.maximum(TONE_TO_NOISE, count * (FALSE_ALARM ** (-1.0 / count) - 1.0))
    return NearTones(DISTANCES[best], amplitude, power, least)


@functools.cache
def _lobes() -> tuple[ComplexArray, ComplexArray, Array]:
    """Return the lines (b,) of a tapered harmonic and of unit tones (d, b) at each distance, and the sizes of these.

    The harmonic has size one, and the tones are without what the harmonic has of them.
    """
    share = (np.arange(LOBE_POINTS) + 0.5) / LOBE_POINTS
    taper = blackman_taper(share)
    waves = np.exp(-2j * np.pi * np.outer(np.arange(-AROUND, AROUND + 1), share)) * (taper / taper.sum())
    harmonic, tones = waves.sum(axis=1), np.exp(2j * np.pi * np.outer(DISTANCES, share)) @ waves.T
    harmonic /= np.linalg.norm(harmonic)
    tones -= np.outer(tones @ harmonic.conj(), harmonic)
    return harmonic, tones, np.linalg.norm(tones, axis=1)
