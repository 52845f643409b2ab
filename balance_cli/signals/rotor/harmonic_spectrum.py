"""The spectrum of a rotor harmonic: a line at constant speed, a band where the speed varies.

A load exp(j n psi(t)) excites a channel through T over the whole band. Regression on azimuth then yields

    integral w conj(b) (h * b) dt / integral w |b|^2 dt = sum_k S_k T(f_k),   b = exp(j n psi),  S_k = conj(W_k) B_k

with B the spectrum of b, W that of w b (Parseval), and S scaled to a sum of one. At constant speed this is T at n times
the speed; where the speed varies near a lightly damped mode the two differ by several percent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.rotor.azimuth import Azimuth
from balance_cli.signals.rotor.edge_weight import edge_weight
from balance_cli.signals.rotor.harmonics import Harmonics
from balance_cli.signals.rotor.line_sums import unit_powers

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LEAST_LINE_WEIGHT = 1e-7
"""Weight of a line over the largest, below which it is dropped.

The lines of a short record reach far into the slopes of a light mode. There a share of 1e-4 changed a load in 50
revolutions, 2 % beside a mode with a damping ratio of 0.008, by 1e-4, and this share by 1e-7; there are four times as
many lines.
"""
FAR_LINE_WEIGHT = 1e-4
"""Weight of a line over the largest, up to which a response that ends before it is taken at its end."""
SAMPLES_PER_HZ_OF_SPEED = 4.0
"""Sample rate over the rotor speed: the harmonic is shifted to zero frequency, and its band is far narrower."""


@dataclass(frozen=True)
class HarmonicLines:
    """Frequencies (g,) [Hz] of a harmonic, and their complex weights (g,), whose sum is one."""

    frequency: Array
    weight: ComplexArray

    def moved_into(self, lowest: float, highest: float) -> HarmonicLines:
        """Return the lines with those far from the harmonic, which weigh little, moved into a band [Hz].

        A measured response ends: that of the band's end serves for lines beyond it.
        """
        size = np.abs(self.weight)
        far = size <= FAR_LINE_WEIGHT * size.max()
        frequency = np.where(far, np.clip(self.frequency, lowest, highest), self.frequency)
        return HarmonicLines(frequency, self.weight)


def harmonic_lines(
    azimuth: Azimuth, spectra: Harmonics, orders: Sequence[int], decay_time: float
) -> tuple[HarmonicLines, ...]:
    """Compute the lines of each of the harmonics over the interval of `spectra`.

    `decay_time` [s] is the time in which the response of the balance decays; a mode without damping has no end of it,
    and the length of the record takes its place. Outside the pulses the rotor is assumed to turn at the speed that it
    has at the first or the last one.
    """
    from scipy.fft import fft

    carriers = carrier_envelopes(azimuth, spectra, orders, decay_time)
    products = np.conj(fft(carriers.weight * carriers.envelopes, axis=1)) * fft(carriers.envelopes, axis=1)
    return tuple(_lines(S, f + carriers.grid) for f, S in zip(carriers.frequency, products, strict=True))


@dataclass(frozen=True)
class CarrierEnvelopes:
    """Signals exp(j n psi) = envelope exp(2 pi j f t) at `time` (t,) [s]: `envelopes` (k, t), `frequency` f (k,) [Hz].

    They are periodic. `weight` (t,) is that of the regression, `grid` (t,) the frequencies [Hz] of the
    discrete spectrum of an envelope.
    """

    time: Array
    frequency: Array
    envelopes: ComplexArray
    weight: Array
    grid: Array


def carrier_envelopes(
    azimuth: Azimuth, spectra: Harmonics, orders: Sequence[int], decay_time: float
) -> CarrierEnvelopes:
    """Return the carriers of harmonics, shifted to zero frequency, over the record and `decay_time` [s] beyond it.

    From there on the speed returns from that at the last pulse to that at the first one within as long again on either
    side, so that the envelopes are periodic: at constant speed they are one, and the harmonic is a single line. An
    envelope that fades out would be a load that is switched on, to which a light mode responds for longer.
    """
    from scipy.fft import next_fast_len

    decay_time = min(decay_time, azimuth.last - azimuth.first)
    rate = SAMPLES_PER_HZ_OF_SPEED * azimuth.mean_rate
    start, stop = azimuth.first - 2 * decay_time, azimuth.last + 2 * decay_time
    time = start + np.arange(next_fast_len(int((stop - start) * rate) + 2)) / rate
    # The carrier of harmonic n is n times the mean rate, so that all harmonics are powers of one signal.
    carrier = float(spectra.frequency_hz[1])
    turns = azimuth.extrapolated_count(time)
    inside = (time >= spectra.interval[0]) & (time <= spectra.interval[1])
    weight = np.where(inside, edge_weight(turns, *spectra.revolutions), 0.0)
    grid = np.asarray(np.fft.fftfreq(len(time), 1.0 / rate), float)
    lead = _periodic_lead(turns - carrier * time, time, azimuth, decay_time)
    powers = unit_powers(2.0 * np.pi * lead, max(orders))
    return CarrierEnvelopes(time, carrier * np.array(orders, float), powers[list(orders)], weight, grid)


def _periodic_lead(lead: Array, time: Array, azimuth: Azimuth, decay_time: float) -> Array:
    """Return the lead (t,) [revolutions] of a rotor over a constant speed, made periodic far from its pulses.

    More than `decay_time` from the pulses it is the cubic that continues value and slope on either side, by whole
    revolutions, which no harmonic shows.
    """
    kept = np.flatnonzero((time >= azimuth.first - decay_time) & (time <= azimuth.last + decay_time))
    first, last = int(kept[0]), int(kept[-1])
    if first == 0 or last - first < 2:
        return lead
    gap = len(time) - (last - first)
    slopes = np.array([lead[last] - lead[last - 1], lead[first + 1] - lead[first]]) * gap
    rise = lead[first] - lead[last]
    rise -= np.round(rise - slopes.mean())
    u = np.arange(1, gap) / gap
    bridge = lead[last] + u * (slopes[0] + u * (3.0 * rise - 2.0 * slopes[0] - slopes[1]))
    bridge += u**3 * (slopes.sum() - 2.0 * rise)
    periodic = lead.copy()
    periodic[np.arange(last + 1, last + gap) % len(time)] = bridge
    return periodic


def _lines(S: ComplexArray, frequencies: Array) -> HarmonicLines:
    """Return the lines of a harmonic from the products S of the two spectra."""
    magnitude = np.abs(S)
    significant = magnitude > LEAST_LINE_WEIGHT * magnitude.max()
    frequency = frequencies[significant]
    order = np.argsort(frequency)
    return HarmonicLines(frequency[order], (S[significant] / S[significant].sum())[order])
