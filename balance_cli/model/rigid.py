"""The equations of the rigid balance: plate, torque shaft and channels, from a geometry and its parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.channel import Channel
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.identity_cache import cached_by_identity
from balance_cli.campaign.rig.kinematics import ROTATION_ORDER, elongation_matrix
from balance_cli.campaign.rig.rig_scales import rig_frequency
from balance_cli.campaign.rig.torque_meter import shaft_inputs, twist_rows
from balance_cli.model.damping import modal_damping
from balance_cli.model.mechanics.dual_numbers import Dual, block_diagonal, concatenate, constant, stack
from balance_cli.model.mechanics.equations import (
    SHAFT,
    TORQUE,
    ChannelPath,
    Equations,
    PointMotion,
    SpringSum,
)
from balance_cli.model.parameters import INERTIA_NAMES
from balance_cli.model.plate import free_index, load_matrix

Array = NDArray[np.float64]


def rigid_equations(geometry: Geometry, value: Mapping[str, Dual], p: int) -> Equations:
    """Equations of plate and shaft at the parameters `value` by name, with derivatives by `p` free parameters."""
    mass, B, F = _plate(geometry, value)
    k, plate_damping = _springs_and_damping(geometry, value, B)
    springs = (*geometry.cell_names, *(meter.label(TORQUE) for meter in geometry.shaft_meters))
    coordinates = (*geometry.freedom, *(meter.label(SHAFT) for meter in geometry.shaft_meters))
    damping, n = plate_damping(mass), len(coordinates)
    if geometry.shaft_meters:
        mass, damping, B, k, F = _with_shafts(geometry, value, mass, damping, B, k, F)
    equations = Equations(
        coordinates=coordinates,
        springs=springs,
        mass=mass,
        damping=damping,
        gyroscopic=constant(np.zeros((n, n)), p),
        extra_stiffness=constant(np.zeros((n, n)), p),
        elongation=B,
        stiffness=k,
        loss=constant(np.zeros(len(springs)), p),
        frequency_stiffness=constant(np.zeros(len(springs)), p),
        reference_frequency=rig_frequency(geometry),
        extra_readings=constant(np.zeros((len(springs), n)), p),
        inputs=F,
        paths=_channel_paths(geometry, springs, value, p),
        exciter_cross_axis=constant(np.eye(6), p),
        weight_cross_axis=constant(np.eye(6), p),
        load_gain=constant(np.ones(6), p),
        load_delay=constant(np.zeros(6), p),
        load_lag=constant(np.zeros((6, 2)), p),
        exciter_mass=constant(np.zeros((6, 6)), p),
        exciter_stiffness=constant(np.zeros((6, 6)), p),
        center=stack([value[f"centre_of_gravity.{axis}"] for axis in "xyz"]),
        freedom=tuple(free_index(geometry)),
        non_metric_motion=constant(np.zeros((6, n)), p),
        row_factor=constant(np.ones(n), p),
        own_stiffness=np.zeros(n),
        channel_offset=constant(np.zeros(len(geometry.channels)), p),
        load_offset=constant(np.zeros(6), p),
        plate_damping=plate_damping,
    )
    return _with_unstiff_springs(equations, _further_sources(geometry), geometry.cell_names)


def _springs_and_damping(geometry: Geometry, value: Mapping[str, Dual], B: Dual) -> tuple[Dual, Callable[[Dual], Dual]]:
    """Stiffness (cells,) of the cells, and the damping of the plate (n, n) for a mass matrix (n, n)."""
    k = stack([value[f"stiffness.{cell.name}"] for cell in geometry.cells])
    zeta = stack([value[f"damping_ratio.{i + 1}"] for i in range(len(geometry.freedom))])
    stiffness = B.T @ (k.insert_axis(-1) * B)
    return k, lambda mass: modal_damping(mass, stiffness, zeta)


def _plate(geometry: Geometry, value: Mapping[str, Dual]) -> tuple[Dual, Dual, Dual]:
    """M (n, n), B (cells, n) and F (n, 6) of the plate; B and F are linear in the center of gravity."""
    free = free_index(geometry)
    mass = value["mass"] * np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    for name in INERTIA_NAMES:
        mass = mass + value[f"inertia.{name}"] * _inertia_pattern(name)
    center = [value[f"centre_of_gravity.{axis}"] for axis in "xyz"]
    (B, of_elongation), (F, of_inputs) = _elongation_by_center(geometry), _inputs_by_center(geometry)
    elongation, inputs = constant(B, mass.parameters), constant(F, mass.parameters)
    for coordinate, change, input_change in zip(center, of_elongation, of_inputs, strict=True):
        elongation = elongation + coordinate * change
        inputs = inputs + coordinate * input_change
    return mass[np.ix_(free, free)], elongation[:, free], inputs[free]


@cached_by_identity
def _elongation_by_center(geometry: Geometry) -> tuple[Array, list[Array]]:
    """B (cells, 6) with the center of gravity at the origin, and its change (cells, 6) with each coordinate of it."""
    B = elongation_matrix(geometry, np.zeros(3))
    return B, [elongation_matrix(geometry, unit) - B for unit in np.eye(3)]


@cached_by_identity
def _inputs_by_center(geometry: Geometry) -> tuple[Array, list[Array]]:
    """F (6, 6) with the center of gravity at the origin, and its change (6, 6) with each coordinate of it."""
    F = load_matrix(geometry, np.zeros(3))
    return F, [load_matrix(geometry, unit) - F for unit in np.eye(3)]


@cache
def _inertia_pattern(name: str) -> Array:
    """The derivative (6, 6) of M by one of the six inertia numbers; products enter with a minus sign."""
    i, j = "xyz".index(name[0]), "xyz".index(name[1])
    tensor = np.zeros((3, 3))
    tensor[i, j] = tensor[j, i] = 1.0 if i == j else -1.0
    pattern = np.zeros((6, 6))
    pattern[3:, 3:] = ROTATION_ORDER @ tensor @ ROTATION_ORDER.T
    return pattern


def _with_shafts(
    geometry: Geometry, value: Mapping[str, Dual], mass: Dual, damping: Dual, B: Dual, k: Dual, F: Dual
) -> tuple[Dual, Dual, Dual, Dual, Dual]:
    """The shafts: J_i phi_i'' + sum_j s_ji (d_j t_j' + k_j t_j) = M_i with twists t = S phi, d = 2 zeta sqrt(k J).

    Of one meter beside the plate J phi'' + d phi' + k phi = Mz. The last twist of a shaft that the plate carries counts
    from the plate, which feels its torque.
    """
    meters, p = geometry.shaft_meters, mass.parameters
    J, stiffness, zeta = (
        stack([value[f"{meter.parameter}.{name}"] for meter in meters])
        for name in ("inertia", "stiffness", "damping_ratio")
    )
    d = 2.0 * zeta * (stiffness * J).sqrt()
    own, plate = twist_rows(meters)
    twist = constant(np.hstack([plate[:, free_index(geometry)], own]), p)
    wide = concatenate([B, constant(np.zeros((len(geometry.cells), len(meters))), p)], axis=1)
    still = constant(np.zeros((len(meters), len(meters))), p)
    return (
        block_diagonal(mass, J.insert_axis(-1) * np.eye(len(meters))),
        block_diagonal(damping, still) + twist.T @ (d.insert_axis(-1) * twist),
        concatenate([wide, twist]),
        concatenate([k, stiffness]),
        concatenate([F, constant(shaft_inputs(meters), p)]),
    )


def _further_sources(geometry: Geometry) -> list[Channel]:
    """One channel of each sum of cells and of each accelerometer, in declared order: each reads a spring of its own."""
    first: dict[str, Channel] = {}
    for channel in geometry.channels:
        if channel.cells is not None or channel.accelerometer is not None:
            first.setdefault(channel.source, channel)
    return list(first.values())


def _with_unstiff_springs(equations: Equations, sources: Sequence[Channel], cells: Sequence[str]) -> Equations:
    """The equations with a spring without stiffness for each source: a sum of cells, or the motion of a point."""
    if not sources:
        return equations
    p, stiff, n = equations.parameters, len(equations.springs), len(equations.coordinates)
    sums, motions = [], []
    for spring, channel in enumerate(sources, stiff):
        if channel.accelerometer is None:
            sums.append(SpringSum(spring, {cells.index(name): w for name, w in channel.cell_weights.items()}))
        else:
            sensor = channel.accelerometer
            position = np.asarray(sensor.position, float)
            motions.append(PointMotion(spring, position, sensor.direction, sensor.side == "metric"))
    rows, nothing = constant(np.zeros((len(sources), n)), p), constant(np.zeros(len(sources)), p)
    return replace(
        equations,
        springs=(*equations.springs, *(channel.source for channel in sources)),
        elongation=concatenate([equations.elongation, rows]),
        extra_readings=concatenate([equations.extra_readings, rows]),
        stiffness=concatenate([equations.stiffness, nothing]),
        loss=concatenate([equations.loss, nothing]),
        frequency_stiffness=concatenate([equations.frequency_stiffness, nothing]),
        sums=tuple(sums),
        point_motions=tuple(motions),
    )


def _channel_paths(
    geometry: Geometry, springs: tuple[str, ...], value: Mapping[str, Dual], p: int
) -> tuple[ChannelPath, ...]:
    """The path of each channel; springs without stiffness follow the others."""
    names = (*springs, *(channel.source for channel in _further_sources(geometry)))
    return tuple(_channel_path(channel, names, value, p) for channel in geometry.channels)


def _torque_spring(channel: Channel) -> str:
    """Name of the spring of a channel's torque meter; empty for other channels."""
    if not channel.torque_meter:
        return ""
    return TORQUE if channel.torque_meter is True else f"{TORQUE} {channel.torque_meter}"


def _channel_path(channel: Channel, springs: tuple[str, ...], value: Mapping[str, Dual], p: int) -> ChannelPath:
    spring = springs.index(_torque_spring(channel) or channel.cell or channel.source)
    low = () if channel.lowpass is None else (constant(1.0 / (2 * np.pi * channel.lowpass), p),)
    high = () if channel.time_constant is None else (constant(1.0 / channel.time_constant, p),)
    differentiations = 0 if channel.accelerometer is None else 2
    gain = value[f"sensitivity.{channel.name}"]
    return ChannelPath(channel.name, spring, gain, low, high, differentiations=differentiations)
