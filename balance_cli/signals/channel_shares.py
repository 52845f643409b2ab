"""Weights of the channels of one spring, which measure the same force, at every frequency."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.channel import Channel
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.signals.run_spectrum import StaticPoints

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Below this many radians per time constant a high-pass channel gets only this fraction of its weight: there the inverse
# of the high-pass turns the start of the record into a ramp.
HIGH_PASS_RADIANS = 20.0
HIGH_PASS_WEIGHT = 1e-9


def channel_shares(geometry: Geometry, names: Sequence[str], frequency: Array, variance: Array) -> Array:
    """Weights (F, c) of channels of given variance (c,) among those of their spring; zero where all gains are zero."""
    by_name = {channel.name: channel for channel in geometry.channels}
    channels = [by_name[name] for name in names]
    gains = np.stack([_declared_gain(channel, frequency) for channel in channels], axis=1)
    weight = np.abs(gains) ** 2 / np.where(variance > 0, variance, 1.0)
    weight = weight * np.stack([_high_pass_weights(channel, frequency) for channel in channels], axis=1)
    springs = [channel.source for channel in channels]
    same_spring = np.array([[a == b for b in springs] for a in springs], float)
    total = weight @ same_spring
    return np.asarray(weight / np.where(total > 0, total, 1.0))


def _high_pass_weights(channel: Channel, frequency: Array) -> Array:
    """Factors (F,) of the weights: 1, or `HIGH_PASS_WEIGHT` where a high-pass depends on the start of the record."""
    if channel.time_constant is None:
        return np.ones(len(frequency))
    return np.where(2 * np.pi * frequency * channel.time_constant < HIGH_PASS_RADIANS, HIGH_PASS_WEIGHT, 1.0)


def add_channel_shares(points: StaticPoints, geometry: Geometry) -> StaticPoints:
    """Add the weight of each channel among those of its spring to the points."""
    share = channel_shares(geometry, points.channel_names, np.zeros(1), np.diag(points.covariance))[0]
    return replace(points, share=share)


def _declared_gain(channel: Channel, frequency: Array) -> ComplexArray:
    s = 2j * np.pi * frequency
    gain = np.full(len(s), channel.sensitivity, complex)
    if channel.lowpass is not None:
        gain = gain / (1.0 + s / (2 * np.pi * channel.lowpass))
    return gain if channel.time_constant is None else gain * s / (s + 1.0 / channel.time_constant)
