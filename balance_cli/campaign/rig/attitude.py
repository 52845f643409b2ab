"""The attitude of a rig, and the direction of gravity in its axes.

The rig stands level at pitch = roll = 0. It is first tilted by the pitch about its y axis, then by the roll about its
own x axis, which the pitch has tilted with it; both right-handed, so that a positive pitch lowers the +x side and a
positive roll lifts the +y side. Rig axes follow from those of the level rig by R = Ry(pitch) Rx(roll).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]

ANGLES = ("pitch", "roll")
ATTITUDE_TOLERANCE = 2e-3
"""Change of the direction of gravity between rows that makes another attitude [rad]: 0.1 deg."""


def gravity_directions(attitude: ArrayLike) -> Array:
    """Unit vectors (m, 3) of gravity in rig axes, R' (0, 0, -1), for pitch and roll (m, 2) [deg]."""
    pitch, roll = np.radians(np.asarray(attitude, float)).T
    return np.column_stack([np.sin(pitch), -np.cos(pitch) * np.sin(roll), -np.cos(pitch) * np.cos(roll)])


def stated_gravity(conditions: Mapping[str, float]) -> Array | None:
    """Direction (3,) of gravity by the attributes `pitch` and `roll` [deg] of a run; None where it has neither."""
    if not any(name in conditions for name in ANGLES):
        return None
    return np.asarray(gravity_directions([[conditions.get(name, 0.0) for name in ANGLES]])[0])


def is_one_direction(gravity: Array) -> bool:
    """Whether all directions of gravity (m, 3) are one, within the tolerance of an attitude."""
    return bool(np.all(np.linalg.norm(gravity - gravity[0], axis=1) <= ATTITUDE_TOLERANCE))


def attitude_segments(run: Index, gravity: Array | None) -> Index:
    """Number (m,) of each segment of rows of one run (m,) in one attitude, from gravity (m, 3), NaN where unknown."""
    new = np.diff(run, prepend=run[:1]) != 0
    if gravity is not None:
        new[1:] |= np.linalg.norm(np.diff(gravity, axis=0), axis=1) > ATTITUDE_TOLERANCE
    return np.asarray(np.cumsum(new), np.intp)
