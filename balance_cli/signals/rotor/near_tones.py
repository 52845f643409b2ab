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
"""Distances [bins] that are tried. Beyond, a tone is a line of its own."""
NEAREST = np.concatenate([sign * np.arange(0.1, 0.76, 0.05) for sign in (-1.0, 1.0)])
"""Distances [bins] of tones that look like a load that drifts, but for their turning: the departure of the amplitude
follows an arc, that of a load which something changes a straight line. Tones at a tenth of a bin turn by 36 degrees."""
ARC_SHARE = 0.05
"""Share of the power, beyond that of noise, that a ramp leaves and an arc may leave: a change along a straight line is
described no better by an arc."""
LEAST_ARC = 4.0
"""Power in the lines of all channels without a ramp, over that of noise and over that without the arc, for an arc to be
told from noise."""
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
    lobes = _lobes()
    noise = _median_power(values, lines.keep) / MEDIAN_OF_EXPONENTIAL + np.finfo(float).tiny
    left = around - lobes.harmonic[:, None] * np.einsum("b,nbc->nc", lobes.harmonic.conj(), around)[:, None]
    far = _best_tone(left, noise, lobes.tones, np.zeros_like(left), (UNEXPLAINED_SHARE, LEAST_TOTAL))
    ramp = lobes.ramp[:, None] * np.einsum("b,nbc->nc", lobes.ramp.conj(), left)[:, None]
    near = _best_tone(left, noise, lobes.near_tones, ramp, (ARC_SHARE, LEAST_ARC))
    is_near = (near.power > 0.0).any(axis=1)
    distance, amplitude, power = (
        np.where(is_near.reshape(-1, *(1,) * (a.ndim - 1)), a, b)
        for a, b in ((near.distance, far.distance), (near.amplitude, far.amplitude), (near.power, far.power))
    )
    count = lines.keep.sum(axis=1)
    least = np.maximum(TONE_TO_NOISE, count * (FALSE_ALARM ** (-1.0 / count) - 1.0))
    return NearTones(distance, amplitude, power, least)


def _median_power(values: ComplexArray, keep: NDArray[np.bool_]) -> Array:
    """Return the median (n, c) of the power of the lines (n, k, c) that are kept (n, k), at least one of each."""
    ordered = np.sort(np.where(keep[:, :, None], values.real**2 + values.imag**2, np.inf), axis=1)
    count = np.count_nonzero(keep, axis=1)
    low, high = (ordered[np.arange(len(count)), middle] for middle in ((count - 1) // 2, count // 2))
    return np.asarray(0.5 * (low + high))


@dataclass(frozen=True)
class _Tones:
    """Lines (d, b) of unit tones at each distance (d,), without what the harmonic has of them, and their sizes."""

    distance: Array
    lines: ComplexArray
    size: Array


@dataclass(frozen=True)
class _Lobes:
    """Lines (b,) of a tapered harmonic and of a ramp of it, both of length one, and tones."""

    harmonic: ComplexArray
    ramp: ComplexArray
    tones: _Tones
    near_tones: _Tones


def _best_tone(
    left: ComplexArray, noise: Array, tones: _Tones, known: ComplexArray, limits: tuple[float, float]
) -> NearTones:
    """Return the tones (n,) that explain the lines (n, b, c) best; their power is zero where something else does.

    Of the lines without what is `known` of them, they leave no more than noise and a share, the first of `limits`; the
    second is the least power of these over that of noise, and over what tones leave.
    """
    fit = np.einsum("db,nbc->ndc", (tones.lines / tones.size[:, None]).conj(), left)
    explained = np.abs(fit) ** 2 / noise[:, None]
    best = np.argmax(explained.sum(axis=2), axis=1)
    at, noise_power = (np.arange(len(best)), best), left[0].size
    total, whole = (np.sum(np.abs(part) ** 2 / noise[:, None], axis=(1, 2)) for part in (left - known, left))
    unexplained = whole - explained[at].sum(axis=1)
    share, least = limits
    clear = (unexplained - noise_power <= share * total) & (total > least * np.maximum(unexplained, noise_power))
    power = np.where(clear[:, None], explained[at], 0.0)
    amplitude = np.where(clear[:, None], np.abs(fit[at]) / tones.size[best][:, None], 0.0)
    return NearTones(tones.distance[best], amplitude, power, np.zeros(len(best)))


@functools.cache
def _lobes() -> _Lobes:
    """Return the lines of harmonic, ramp and tones."""
    share = (np.arange(LOBE_POINTS) + 0.5) / LOBE_POINTS
    taper = blackman_taper(share)
    waves = np.exp(-2j * np.pi * np.outer(np.arange(-AROUND, AROUND + 1), share)) * (taper / taper.sum())
    harmonic = waves.sum(axis=1)
    harmonic /= np.linalg.norm(harmonic)

    def beside(lines: ComplexArray) -> ComplexArray:
        return np.asarray(lines - np.outer(lines @ harmonic.conj(), harmonic))

    def tones(distance: Array) -> _Tones:
        lines = beside((waves @ np.exp(2j * np.pi * np.outer(share, distance))).T)
        return _Tones(distance, lines, np.linalg.norm(lines, axis=1))

    (ramp,) = beside((waves @ share)[None])
    return _Lobes(harmonic, ramp / np.linalg.norm(ramp), tones(DISTANCES), tones(NEAREST))
