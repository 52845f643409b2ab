"""Gains of the channels: sensitivity, first-order filters and delay of each, and their derivatives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.model.mechanics.equations import ChannelPath

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Mask = NDArray[np.bool_]


def channel_gains(paths: Sequence[ChannelPath], frequency: Array) -> ComplexArray:
    """The gains g (k, c), volts per unit of what each channel's spring reads at `frequency` (k,) [Hz]."""
    s = 2j * np.pi * np.asarray(frequency, float)
    keys = [_dynamics_key(path) for path in paths]
    dynamics = {key: channel_dynamics(path, s) for key, path in dict(zip(keys, paths, strict=True)).items()}
    return np.stack([path.gain.value * dynamics[key] for key, path in zip(keys, paths, strict=True)], axis=1)


def _dynamics_key(path: ChannelPath) -> tuple[object, ...]:
    """What the dynamics of a channel depend on: most channels of a balance have those of another."""
    rates = tuple(tuple(float(item.value) for item in part) for part in (path.low_pass, path.high_pass, path.lead))
    return (*rates, None if path.delay is None else float(path.delay.value), path.differentiations)


def channel_dynamics(path: ChannelPath, s: ComplexArray) -> ComplexArray:
    """First-order filters and delay of one channel at s (k,) = j omega, or any other complex s."""
    value = s**path.differentiations if path.differentiations else np.ones_like(s)
    for tau in path.low_pass:
        value = value / (1 + s * tau.value)
    for rate in path.high_pass:
        # s / (s + r) is zero at rest for any rate r > 0, and one without a high-pass.
        value = value * (s / (s + rate.value) if rate.value > 0 else 1.0)
    for tau in path.lead:
        value = value * (1 + s * tau.value)
    return value if path.delay is None else value * np.exp(-s * path.delay.value)


def log_gain_derivatives(paths: Sequence[ChannelPath], frequency: Array) -> ComplexArray:
    """Derivatives (k, c, p) of ln g of each channel, by its gain, time constants, rates and delay."""
    s = 2j * np.pi * np.asarray(frequency, float)[:, None]
    return np.stack([log_gain_derivative(path, s) for path in paths], axis=1)


def log_gain_derivative(path: ChannelPath, s: ComplexArray, own: Mask | slice = slice(None)) -> ComplexArray:
    """Derivatives (k, q) of ln g of one channel at s (k, 1), by the parameters `own` alone; most change no gain."""
    of_gain = path.gain.derivative[own] / path.gain.value
    derivative = np.broadcast_to(of_gain, (len(s), len(of_gain))).astype(complex)
    for tau in path.low_pass:
        derivative = derivative - s / (1 + s * tau.value) * tau.derivative[own]
    for rate in path.high_pass:
        derivative = derivative - rate.derivative[own] / np.where(s + rate.value == 0, np.inf, s + rate.value)
    for tau in path.lead:
        derivative = derivative + s / (1 + s * tau.value) * tau.derivative[own]
    return derivative if path.delay is None else derivative - s * path.delay.derivative[own]


def path_parameters(path: ChannelPath) -> NDArray[np.bool_]:
    """Which parameters (p,) change the gain of a channel."""
    return np.asarray(np.any([part.derivative != 0 for part in path.dual_numbers], axis=0))
