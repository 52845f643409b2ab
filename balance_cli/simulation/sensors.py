"""From forces to recorded volts: sensitivity, each channel's own dynamics, the anti-alias filter.

Every filter starts in equilibrium with its first sample, like a rig that has been standing under its first load.
"""

from __future__ import annotations

import numpy as np
import scipy.signal
from numpy.typing import NDArray

from balance_cli.geometry import AnalogueFilter
from balance_cli.simulation.integrate import first_order
from balance_cli.simulation.rig import TrueRig

Array = NDArray[np.float64]


def low_pass(signal: Array, cutoff: float, step: float) -> Array:
    """First-order low-pass `1 / (1 + s / (2 pi cutoff))` of a signal (n,) sampled every `step` s; cutoff [Hz]."""
    rate = 2 * np.pi * cutoff
    return np.asarray(first_order(-rate, rate * signal[:, None], step, signal[:1])[:, 0])


def high_pass(signal: Array, time_constant: float, step: float) -> Array:
    """First-order high-pass `tau s / (1 + tau s)` of a signal (n,) sampled every `step` s; tau [s]."""
    slow: Array = low_pass(signal, 1 / (2 * np.pi * time_constant), step)
    return signal - slow


def delayed(signal: Array, delay: float, step: float) -> Array:
    """A signal (n,) late by `delay` [s], by the polynomial through the six samples about each instant.

    Before the first sample it had its value; after the last, where a negative delay asks, the last polynomial goes on.
    """
    whole = int(np.floor(-delay / step))
    fraction = -delay / step - whole
    offsets = np.arange(-2, 4)
    others = [np.delete(offsets, i) for i in range(len(offsets))]
    weights = [np.prod((fraction - rest) / (o - rest)) for o, rest in zip(offsets, others, strict=True)]
    places = np.arange(len(signal)) + whole
    shifted = sum(w * signal[np.clip(places + o, 0, len(signal) - 1)] for w, o in zip(weights, offsets, strict=True))
    return np.asarray(shifted)


def anti_alias(signals: Array, declared: AnalogueFilter | None, step: float, stride: int) -> Array:
    """Signals (n, s) through the analogue Butterworth filter, at every `stride`-th sample.

    The filter is solved as the sum of its partial fractions.
    """
    if declared is None:
        return signals[::stride].copy()
    _, poles, gain = scipy.signal.butter(declared.order, 2 * np.pi * declared.cutoff, analog=True, output="zpk")
    filtered = np.zeros((len(signals[::stride]), signals.shape[1]))
    for i, pole in enumerate(poles):
        if pole.imag >= -1e-9 * abs(pole):
            residue = gain / np.prod(pole - np.delete(poles, i))
            real = pole.imag <= 1e-9 * abs(pole)
            part = first_order(pole.real if real else pole, signals, step, -signals[0] / pole, stride)
            filtered += (residue * part).real * (1 if real else 2)
    return filtered


def sensor_volts(rig: TrueRig, forces: Array, step: float | None) -> Array:
    """Volts (n, channels) before the acquisition, from cell forces and torque (n, cells+1) sampled every `step` s.

    Without a `step` the rows are readings at rest: a high-pass passes nothing.
    """
    geometry = rig.geometry
    volts = np.empty((len(forces), len(geometry.channels)))
    for i, (channel, sensitivity) in enumerate(zip(geometry.channels, rig.sensitivities, strict=True)):
        source = -1 if channel.cell is None else geometry.cell_names.index(channel.cell)
        signal = forces[:, source] * sensitivity
        if channel.lowpass is not None and step is not None:
            signal = low_pass(signal, channel.lowpass, step)
        if channel.time_constant is not None:
            signal = high_pass(signal, channel.time_constant, step) if step is not None else np.zeros(len(signal))
        volts[:, i] = signal
    return volts
