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


def anti_alias_filter(declared: AnalogFilter) -> RationalFilter:
    """The analog Butterworth filter."""
    from scipy.signal import butter  # see `integrate.first_order_recursion`

    zeros, poles, gain = butter(declared.order, 2 * np.pi * declared.cutoff, analog=True, output="zpk")
    return RationalFilter(zeros.astype(complex), poles, gain)


def anti_alias(signals: Array, declared: AnalogFilter | None, step: float, stride: int) -> Array:
    """Signals (n, s) through the declared filter, at every `stride`-th sample."""
    if declared is None:
        return signals[::stride].copy()
    none = np.zeros(0, complex)
    system = filter_outputs(
        ModalSystem(none, none[:, None], none[None], np.ones((1, 1))), [anti_alias_filter(declared)]
    )
    filtered = np.empty((len(signals[::stride]), signals.shape[1]))
    for i, column in enumerate(signals.T):
        filtered[:, [i]] = system.response(column[:, None], step, stride)
    return filtered
