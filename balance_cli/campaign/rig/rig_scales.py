"""Stiffness, inertia and middle frequency of a rig as declared."""

from __future__ import annotations

import numpy as np

from balance_cli.campaign.rig.components import FREEDOMS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.identity_cache import cached_by_identity
from balance_cli.campaign.rig.kinematics import motion_at


@cached_by_identity
def stiffness_by_motion(geometry: Geometry) -> dict[str, float]:
    """Stiffness of the cells against each motion x y z [N/m] psi theta phi [N m/rad] of the plate about the origin."""
    rows = np.array([cell.direction @ motion_at(np.array(cell.position)) for cell in geometry.cells])
    diagonal = np.array([cell.effective_stiffness for cell in geometry.cells]) @ rows**2
    return dict(zip(FREEDOMS, diagonal.tolist(), strict=True))


@cached_by_identity
def inertia_by_motion(geometry: Geometry) -> dict[str, float]:
    """Mass [kg] for x y z and moment of inertia [kg m2] about the origin for psi theta phi, of all bodies together."""
    inertia = np.zeros((3, 3))
    for body in geometry.bodies:
        r = np.array(body.position)
        inertia += body.inertia.tensor() + body.mass * (r @ r * np.eye(3) - np.outer(r, r))
    mass = sum(body.mass for body in geometry.bodies)
    return dict(zip(FREEDOMS, (mass, mass, mass, *np.diag(inertia)[::-1].tolist()), strict=True))


@cached_by_identity
def rig_frequency(geometry: Geometry) -> float:
    """The frequency [Hz] in the middle of the rig's modes: geometric mean over its motions, each alone."""
    stiffness, inertia = stiffness_by_motion(geometry), inertia_by_motion(geometry)
    squares = [stiffness[name] / inertia[name] for name in geometry.freedom if stiffness[name] and inertia[name]]
    return float(np.exp(0.5 * np.mean(np.log(squares))) / (2 * np.pi)) if squares else 1.0
