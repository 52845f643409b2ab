"""Small motions of a rigid body in the paper's coordinates (docs/theory/paper-notes.md, note 1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry

Array = NDArray[np.float64]

# The paper's angles (psi, theta, phi) turn about (z, y, x): rows of q, columns of a rotation vector (x, y, z).
ROTATION_ORDER = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])


def cross_matrix(arm: Array) -> Array:
    """The matrix [r]x with [r]x v = r x v, for arms (..., 3)."""
    x, y, z = np.moveaxis(np.asarray(arm, float), -1, 0)
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def _rotation_displacements(arm: Array) -> Array:
    """R (3, 3) of d = [I, R] q at one arm: R q = rotation x arm."""
    return np.asarray(-cross_matrix(arm) @ ROTATION_ORDER.T)


MOTION_AT_CENTER = np.concatenate([np.eye(3), np.zeros((3, 3))], axis=1)
"""Motion (3, 6) of the center itself."""
MOTION_PER_ARM = np.concatenate(
    [np.zeros((3, 3, 3)), np.stack([_rotation_displacements(unit) for unit in np.eye(3)])], axis=2
)
"""What each coordinate of an arm adds to it (3, 3, 6) [1/m]: the motion is linear in the arm."""


def motion_at(arm: Array) -> Array:
    """Motion (..., 3, 6) of points at `arm` (..., 3) [m] from the center of gravity, per unit q: d = [I, R] q.

    R q = rotation x arm, which gives (theta zeta - psi eta, psi xi - phi zeta, phi eta - theta xi).
    """
    return np.asarray(MOTION_AT_CENTER + np.tensordot(np.asarray(arm, float), MOTION_PER_ARM, axes=1))


def elongation_matrix(geometry: Geometry, center: Array) -> Array:
    """B (cells, 6): elongation of each cell along its axis per unit q (paper, eq. 5)."""
    arms = np.array([cell.position for cell in geometry.cells]) - center
    axes = np.array([cell.direction for cell in geometry.cells])
    return np.asarray(np.einsum("ci,cij->cj", axes, motion_at(arms)))
