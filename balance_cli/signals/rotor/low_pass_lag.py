"""The delay of the edges of a pulse by the low-pass that a tachometer passed.

A step passes half of its height at a time that depends on the filter alone. A pulse that is about as short as the
response of the filter does not reach its height, and its edges disturb each other. With the poles p and residues r of
the filter, a train of pulses of width w and period T is, from the rising edge on,

    y(t) = [t < w] + Re sum_i r_i / p_i (exp(p_i t) - exp(p_i s)) / (1 - exp(p_i T)),    s = t - w (+ T where t < w)

The width w is that with which y is above the level for as long as the recorded pulses are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

POINTS = 400
"""Instants of the response to an edge: the level lies between them by a straight line, to 5e-5 over the cutoff."""
BISECTIONS = 22
"""Of the width of the pulse: to 2e-7 of its period."""


@dataclass(frozen=True)
class AnalogLowPass:
    """A Butterworth low-pass that the tachometer passed before it was sampled: order and cutoff [Hz]."""

    order: int
    cutoff: float


@dataclass(frozen=True)
class PulseShape:
    """A recorded pulse: time [s] above the level, time [s] from its rising edge to the next, and the level.

    `share` is the level above the low state over the swing, both at the quantile `extreme` of the samples.
    """

    width: float
    period: float
    share: float
    extreme: float


def edge_delay(low_pass: AnalogLowPass, pulse: PulseShape) -> float | None:
    """Time [s] by which the rising edges of a train of pulses come late; None for pulses shorter than the filter's."""
    train = _Train.of(low_pass, pulse)
    narrow, wide = 1e-6 * pulse.period, (1.0 - 1e-6) * pulse.period
    if not train.width(narrow) < pulse.width < train.width(wide):
        return None
    for _ in range(BISECTIONS):
        middle = 0.5 * (narrow + wide)
        narrow, wide = (middle, wide) if train.width(middle) < pulse.width else (narrow, middle)
    lag = train.crossings(0.5 * (narrow + wide))[0]
    step = step_delay(low_pass, pulse.share)
    return lag + pulse.period * round((step - lag) / pulse.period)


def step_delay(low_pass: AnalogLowPass, share: float) -> float:
    """Time [s] after a step at which the filtered step has passed `share` of it."""
    poles, residues = _filter_poles(low_pass)
    time = np.linspace(0.0, _span(low_pass), 20001)
    response = 1.0 + (np.exp(time[:, None] * poles) @ residues).real
    k = int(np.argmax(response >= share))
    below, above = response[k - 1], response[k]
    return float(time[k - 1] + (share - below) / (above - below) * (time[k] - time[k - 1]))


@dataclass(frozen=True)
class _Train:
    """Trains of pulses behind a low-pass with `poles` and `residues` over poles, which rings for `span` [s]."""

    poles: ComplexArray
    residues: ComplexArray
    span: float
    pulse: PulseShape

    @classmethod
    def of(cls, low_pass: AnalogLowPass, pulse: PulseShape) -> _Train:
        return cls(*_filter_poles(low_pass), _span(low_pass), pulse)

    def width(self, width: float) -> float:
        """Time [s] that pulses of a width [s] are above the level."""
        rise, fall = self.crossings(width)
        return fall - rise

    def crossings(self, width: float) -> tuple[float, float]:
        """Times [s] after a rising edge at which the signal rises through the level, and then falls through it."""
        period = self.pulse.period
        near = np.linspace(0.0, self.span, POINTS)
        time = np.unique(np.concatenate([near, near + width, np.linspace(0.0, period, POINTS)]) % period)
        signal = self._signal(time, width)
        low, high = _extremes(signal, np.diff(np.append(time, period)), self.pulse.extreme)
        above = signal - (low + self.pulse.share * (high - low))
        top = int(np.argmax(signal))
        # A period before the largest value, and one behind it.
        place = np.arange(top - len(time), top + len(time) + 1)
        above, time = above[place % len(time)], time[place % len(time)] + period * (place // len(time))
        center = len(time) // 2
        rising = np.flatnonzero((above[:center] < 0.0) & (above[1 : center + 1] >= 0.0))
        falling = np.flatnonzero((above[center:-1] >= 0.0) & (above[center + 1 :] < 0.0)) + center
        return _crossing(time, above, int(rising[-1])), _crossing(time, above, int(falling[0]))

    def _signal(self, time: Array, width: float) -> Array:
        """The train of pulses of height 1 at times (k,) within its period."""
        period = self.pulse.period
        since = np.where(time < width, time - width + period, time - width)
        waves = np.exp(time[:, None] * self.poles) - np.exp(since[:, None] * self.poles)
        return (time < width) + (waves @ (self.residues / (1.0 - np.exp(self.poles * period)))).real


def _extremes(signal: Array, duration: Array, share: float) -> tuple[float, float]:
    """The values below and above which a signal is for a share of the time, from the time at each of its values."""
    order = np.argsort(signal)
    passed = np.cumsum(duration[order]) / duration.sum()
    low, high = np.interp([share, 1.0 - share], passed, signal[order])
    return float(low), float(high)


def _crossing(time: Array, above: Array, k: int) -> float:
    return float(time[k] - above[k] * (time[k + 1] - time[k]) / (above[k + 1] - above[k]))


def _filter_poles(low_pass: AnalogLowPass) -> tuple[ComplexArray, ComplexArray]:
    """Poles (n,) [rad/s] of a low-pass, and its residues over them."""
    from scipy.signal import butter  # its import takes longer than a reduction, and few records have such a filter

    _, poles, gain = butter(low_pass.order, 2.0 * np.pi * low_pass.cutoff, analog=True, output="zpk")
    residues = np.array([gain / np.prod(pole - np.delete(poles, i)) for i, pole in enumerate(poles)])
    return np.asarray(poles, complex), np.asarray(residues / poles, complex)


def _span(low_pass: AnalogLowPass) -> float:
    """Time [s] after which a step has settled to 1e-3."""
    return (2.0 + low_pass.order) / low_pass.cutoff
