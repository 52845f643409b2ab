"""Volts of the channels before they are recorded, with the effects of the simulated rig.

Rig, sensors and anti-alias filter are one linear system, which is solved at the sample rate at once. Channels that an
effect changes otherwise than by mixing volts are computed on the fine grid, one stage after another.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.channel import Channel
from balance_cli.campaign.rig.geometry import AnalogFilter
from balance_cli.simulation.extensions.base import Extension, Signals
from balance_cli.simulation.filtered_system import (
    NO_FILTER,
    RationalFilter,
    filter_outputs,
    has_distinct_poles,
)
from balance_cli.simulation.filters import anti_alias, anti_alias_filter
from balance_cli.simulation.integrate import ModalSystem
from balance_cli.simulation.motion import RigDynamics
from balance_cli.simulation.rig import TrueRig
from balance_cli.simulation.sensors import sensor_volts, sensor_weights

Array = NDArray[np.float64]


def channel_volts(rig: TrueRig, forces: Array, step: float | None, rng: np.random.Generator) -> Array:
    """Volts (n, channels) before the anti-alias filter, from what the sensors measure (n, c+t+a).

    Samples are `step` s apart; without a step the rows are readings at rest.
    """
    return _with_effects(rig, sensor_volts(rig, forces, step), step, rng)


def _with_effects(rig: TrueRig, volts: Array, step: float | None, rng: np.random.Generator) -> Array:
    for extension in rig.extensions:
        volts = extension.volts(Signals(volts, rig.geometry.channel_names, step, rng))
    return volts


def sampled_volts(
    rig: TrueRig,
    motion: RigDynamics,
    inputs: Array,
    step: float,
    stride: int,
    declared: AnalogFilter | None,
    rng: np.random.Generator,
) -> Array:
    """Volts (ceil(n/stride), channels) behind the `declared` filter at every `stride`-th sample.

    `inputs` (n, 6+m) are the hub loads and the nonlinear forces, sampled every `step` s. `rng`: as in `Signals`.
    """
    readings, own = _readings(rig, motion), [_own_filter(channel) for channel in rig.geometry.channels]
    common = NO_FILTER if declared is None else anti_alias_filter(declared)
    both = [each @ common for each in own]
    if not has_distinct_poles(readings, both):
        return anti_alias(channel_volts(rig, motion.forces(inputs, step), step, rng), declared, step, stride)
    volts = filter_outputs(readings, both).response(inputs, step, stride)
    if all(type(each).volts is Extension.volts or each.is_mixture for each in rig.extensions):
        return _with_effects(rig, volts, stride * step, rng)
    plain = filter_outputs(readings, own).response(inputs, step)
    fine = _with_effects(rig, plain.copy(), step, rng)
    changed = np.any(fine != plain, axis=0)
    volts[:, changed] = anti_alias(fine[:, changed], declared, step, stride)
    return volts


def _readings(rig: TrueRig, motion: RigDynamics) -> ModalSystem:
    """The channels before any filter, as a linear system of hub loads and nonlinear forces."""
    sensors = motion.sensor_system
    weights = sensor_weights(rig.geometry) * np.asarray(rig.sensitivities)[:, None]
    return ModalSystem(sensors.poles, sensors.inputs, weights @ sensors.outputs, weights @ sensors.direct)


def _own_filter(channel: Channel) -> RationalFilter:
    """What a channel's own filters make of its reading."""
    own = NO_FILTER
    if channel.lowpass is not None:
        rate = 2 * np.pi * channel.lowpass
        own @= RationalFilter(np.zeros(0, complex), np.array([-rate], complex), rate)
    if channel.time_constant is not None:
        own @= RationalFilter(np.zeros(1, complex), np.array([-1 / channel.time_constant], complex), 1.0)
    return own
