"""Filters of signals in the time domain: first order, delay, anti-alias."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import AnalogFilter
from balance_cli.simulation.filtered_system import RationalFilter, filter_outputs
from balance_cli.simulation.integrate import ModalSystem, integrate_first_order

Array = NDArray[np.float64]


def low_pass(signal: Array, cutoff: float, step: float) -> Array:
    """First-order low-pass `1 / (1 + s / (2 pi cutoff))` of a signal (n,) sampled every `step` s; cutoff [Hz]."""
    rate = 2 * np.pi * cutoff
    return np.asarray(integrate_first_order(-rate, rate * signal[:, None], step, signal[:1])[:, 0])


def high_pass(signal: Array, time_constant: float, step: float) -> Array:
    """First-order high-pass `tau s / (1 + tau s)` of a signal (n,) sampled every `step` s; tau [s]."""
    slow: Array = low_pass(signal, 1 / (2 * np.pi * time_constant), step)
    return signal - slow


def delay_signal(signal: Array, delay: float, step: float) -> Array:
    """A signal (n,) late by `delay` [s], by the polynomial through the six samples about each instant.

    Before the first sample it had its value; after the last, where a negative delay asks, the last polynomial goes on.
    """
    shift = int(np.floor(-delay / step))
    fraction = -delay / step - shift
    offsets = np.arange(-2, 4)
    nodes = [(offset, np.delete(offsets, i)) for i, offset in enumerate(offsets)]
    weights = [np.prod((fraction - rest) / (offset - rest)) for offset, rest in nodes]
    places = np.arange(len(signal)) + shift
    shifted = sum(w * signal[np.clip(places + o, 0, len(signal) - 1)] for w, o in zip(weights, offsets, strict=True))
    return np.asarray(shifted)


def derivative(signal: Array, step: float) -> Array:
    """The derivative in time of a signal (n,), by the polynomial through the seven samples about each instant."""
    weights = np.array([-1, 9, -45, 0, 45, -9, 1]) / (60.0 * step)
    rate: Array = np.convolve(np.pad(signal, 3, mode="edge"), weights[::-1], mode="valid")
    return rate


def followed(signal: Array, terms: tuple[float, float], step: float) -> Array:
    """The x (n,) of which x + a x' + b x'' is a signal (n,), with `terms` a [s] and b [s2], at rest before it."""
    order = 2 if terms[1] > 0.0 else 1
    if terms[order - 1] == 0.0:
        return signal
    poles = np.roots([*terms[:order][::-1], 1.0]).astype(complex)
    rational = RationalFilter(np.zeros(0, complex), poles, 1.0 / terms[order - 1])
    return np.asarray(signal[0] + _filtered(signal - signal[0], rational, step))


def anti_alias_filter(declared: AnalogFilter) -> RationalFilter:
    """The analog Butterworth filter."""
    from scipy.signal import butter  # see `integrate.first_order_recursion`

    zeros, poles, gain = butter(declared.order, 2 * np.pi * declared.cutoff, analog=True, output="zpk")
    return RationalFilter(zeros.astype(complex), poles, gain)


def anti_alias(signals: Array, declared: AnalogFilter | None, step: float, stride: int) -> Array:
    """Signals (n, s) through the declared filter, at every `stride`-th sample."""
    if declared is None:
        return signals[::stride].copy()
    filtered = np.empty((len(signals[::stride]), signals.shape[1]))
    for i, column in enumerate(signals.T):
        filtered[:, i] = _filtered(column, anti_alias_filter(declared), step, stride)
    return filtered


def _filtered(signal: Array, rational: RationalFilter, step: float, stride: int = 1) -> Array:
    """A signal (n,) through a filter, at every `stride`-th sample."""
    none = np.zeros(0, complex)
    system = filter_outputs(ModalSystem(none, none[:, None], none[None], np.ones((1, 1))), [rational])
    return np.asarray(system.response(signal[:, None], step, stride)[:, 0])
