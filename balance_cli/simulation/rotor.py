"""The turning rotor: azimuth, 1/rev pulses, and loads as functions of azimuth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RotorKinematics:
    """Rotor speed `speed (1 + drift sin(2 pi t / drift_period + drift_phase))` [Hz]; azimuth 0 at t = 0."""

    speed: float
    drift: float = 0.0
    drift_period: float = 23.0
    drift_phase: float = 0.42

    def rate(self, time: Array) -> Array:
        """Speed [Hz] at `time` [s]."""
        swing = np.sin(2 * np.pi * time / self.drift_period + self.drift_phase)
        rate: Array = self.speed * (1 + self.drift * swing)
        return rate

    def azimuth(self, time: Array) -> Array:
        """Azimuth [rad] at `time` [s], increasing without wrapping."""
        omega = 2 * np.pi / self.drift_period
        swing = (np.cos(self.drift_phase) - np.cos(omega * time + self.drift_phase)) / omega
        azimuth: Array = 2 * np.pi * self.speed * (time + self.drift * swing)
        return azimuth

    def pulse_times(self, duration: float) -> Array:
        """Times [s] after the first sample, before `duration`, at which the azimuth is a multiple of 2 pi."""
        coarse = np.linspace(0, duration, 1 + int(np.ceil(duration * self.speed * 8)))
        azimuths = self.azimuth(coarse)
        targets = 2 * np.pi * np.arange(1, int(azimuths[-1] / (2 * np.pi)) + 1)
        times = np.interp(targets, azimuths, coarse)
        for _ in range(4):
            times = times - (self.azimuth(times) - targets) / (2 * np.pi * self.rate(times))
        inside: Array = times[times < duration]
        return inside


def harmonic_load(azimuth: Array, cosine: Array, sine: Array) -> Array:
    """`sum_n cosine_n cos(n psi) + sine_n sin(n psi)` (n_time,) for n = 0 .. len-1."""
    phasors = np.exp(1j * azimuth)
    turning = np.ones_like(phasors)
    load = np.full(len(azimuth), cosine[0], float)
    for c, s in zip(cosine[1:], sine[1:], strict=True):
        turning = turning * phasors
        load += c * turning.real + s * turning.imag
    return load


def harmonics(azimuth: Array, signals: Array, count: int) -> tuple[Array, Array]:
    """Cosine and sine parts (count+1, s) of `signals` (n, s) at harmonics 0 to `count` of the azimuth (n,).

    Least squares over the samples given: exact where the signals contain only these harmonics.
    """
    orders = np.arange(1, count + 1)
    turned = azimuth[:, None] * orders
    basis = np.hstack([np.ones((len(azimuth), 1)), np.cos(turned), np.sin(turned)])
    parts = np.linalg.lstsq(basis, signals, rcond=None)[0]
    sine = np.vstack([np.zeros(signals.shape[1]), parts[count + 1 :]])
    return parts[: count + 1], sine


def smooth_step(time: Array, start: float, duration: float) -> Array:
    """From 0 before `start` to 1 after `start + duration`, a raised cosine in between (n,)."""
    ramp: Array = 0.5 - 0.5 * np.cos(np.pi * np.clip((time - start) / duration, 0, 1))
    return ramp
