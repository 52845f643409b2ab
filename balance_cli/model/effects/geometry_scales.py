"""Stiffness, inertia and extent of a rig as declared: the scales of the effects' parameters."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import FREEDOMS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.kinematics import motion_at

Array = NDArray[np.float64]


def transverse_axes(axis: Array) -> tuple[Array, Array]:
    """Two unit vectors (3,) perpendicular to a unit `axis`, right-handed; y and z for a cell along x.

    The first is the rig axis that follows, in cyclic order, the axis nearest to the cell's, made orthogonal to the
    cell's.
    """
    following = np.eye(3)[(int(np.argmax(np.abs(axis))) + 1) % 3]
    transverse = following - (following @ axis) * axis
    first = transverse / np.linalg.norm(transverse)
    return first, np.cross(axis, first)


def stiffness_by_motion(geometry: Geometry) -> dict[str, float]:
    """Stiffness of the cells against each motion x y z [N/m] psi theta phi [N m/rad] of the plate about the origin."""
    rows = np.array([cell.direction @ motion_at(np.array(cell.position)) for cell in geometry.cells])
    diagonal = np.array([cell.effective_stiffness for cell in geometry.cells]) @ rows**2
    return dict(zip(FREEDOMS, diagonal.tolist(), strict=True))


def inertia_by_motion(geometry: Geometry) -> dict[str, float]:
    """Mass [kg] for x y z and moment of inertia [kg m2] about the origin for psi theta phi, of all bodies together."""
    inertia = np.zeros((3, 3))
    for body in geometry.bodies:
        r = np.array(body.position)
        inertia += body.inertia.tensor() + body.mass * (r @ r * np.eye(3) - np.outer(r, r))
    mass = sum(body.mass for body in geometry.bodies)
    return dict(zip(FREEDOMS, (mass, mass, mass, *np.diag(inertia)[::-1].tolist()), strict=True))


def position_bound(geometry: Geometry) -> float:
    """Twice the largest distance [m] of hub, cells and bodies from the origin: effects are not looked for beyond it."""
    points = [geometry.hub, *(cell.position for cell in geometry.cells), *(body.position for body in geometry.bodies)]
    return 2.0 * float(np.linalg.norm(np.array(points), axis=1).max()) or np.inf
