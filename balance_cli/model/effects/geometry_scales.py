"""Extent, loads and readings of a rig as declared: the scales of the effects' parameters."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import FREEDOMS
from balance_cli.campaign.rig.geometry import Cell, Geometry
from balance_cli.campaign.rig.rig_scales import inertia_by_motion, rig_frequency
from balance_cli.model.effects.base import EffectParameter

Array = NDArray[np.float64]

SMALL_ARM = 0.13
"""A change of place that matters, relative to the size of the rig."""


def transverse_axes(axis: Array) -> tuple[Array, Array]:
    """Two unit vectors (3,) perpendicular to a unit `axis`, right-handed; y and z for a cell along x.

    The first is the rig axis that follows, in cyclic order, the axis nearest to the cell's, made orthogonal to the
    cell's.
    """
    following = np.eye(3)[(int(np.argmax(np.abs(axis))) + 1) % 3]
    transverse = following - (following @ axis) * axis
    first = transverse / np.linalg.norm(transverse)
    return first, np.cross(axis, first)


def position_bound(geometry: Geometry) -> float:
    """Twice the largest distance [m] of hub, cells and bodies from the origin: effects are not looked for beyond it."""
    return 2.0 * _largest_distance(geometry) or np.inf


def _largest_distance(geometry: Geometry) -> float:
    points = [geometry.hub, *(cell.position for cell in geometry.cells), *(body.position for body in geometry.bodies)]
    return float(np.linalg.norm(np.array(points), axis=1).max())


def corner_positions(geometry: Geometry) -> tuple[dict[str, float], ...]:
    """Coordinates x y z [m] of the corners of a cube about the origin, on each axis half as far as the rig reaches."""
    half = 0.5 * _largest_distance(geometry)
    return tuple(dict(zip("xyz", corner, strict=True)) for corner in product((-half, half), repeat=3))


def attachment_position(geometry: Geometry, description: str) -> tuple[EffectParameter, ...]:
    """Coordinates x y z [m] of a point of attachment, from half way up to the hub.

    At the origin the moments of forces there have no derivative. `description` has the axis in braces: `{axis}`.
    """
    far, arm = position_bound(geometry), SMALL_ARM * rig_length(geometry)
    return tuple(
        EffectParameter(axis, "m", 0.0, arm, description.format(axis=axis), -far, far, 0.5 * hub, nuisance=True)
        for axis, hub in zip("xyz", geometry.hub, strict=True)
    )


def rig_length(geometry: Geometry) -> float:
    """The size of the rig [m]: the largest distance of its parts from the origin, or a radius of gyration about it."""
    inertia = inertia_by_motion(geometry)
    gyration = np.sqrt(max(inertia[name] for name in FREEDOMS[3:]) / inertia["z"])
    return _largest_distance(geometry) or float(gyration) or 1.0


def cell_speed(geometry: Geometry, cell: Cell) -> float:
    """The speed [m/s] of a cell that moves through its range at the frequency in the middle of the rig's modes."""
    return 2.0 * np.pi * rig_frequency(geometry) * cell.full_range / cell.effective_stiffness


def load_range(geometry: Geometry, component: str) -> float:
    """The load [N, N m] that the largest cell can carry, a moment at the arm of the rig's size."""
    force = max(cell.full_range for cell in geometry.cells)
    return force if component.startswith("F") else force * rig_length(geometry)


def channel_range(geometry: Geometry, channel_name: str) -> float:
    """The reading [V] of a channel where its cells are at their range, or, of another channel, that of a mean cell."""
    channel = next(item for item in geometry.channels if item.name == channel_name)
    ranges = {cell.name: cell.full_range for cell in geometry.cells}
    mean = sum(ranges.values()) / len(ranges)
    if channel.accelerometer is not None:
        return abs(channel.sensitivity) * mean / sum(body.mass for body in geometry.bodies)
    if channel.torque_meter:
        return abs(channel.sensitivity) * rig_length(geometry) * mean
    of_cells = sum(abs(weight) * ranges[name] for name, weight in channel.cell_weights.items())
    return abs(channel.sensitivity) * (of_cells or mean)
