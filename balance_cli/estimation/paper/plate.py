"""The rigid plate of the paper's section 3, as far as its own form of identification needs it: P, and start values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.components import COMPONENTS, FREEDOMS
from balance_cli.geometry import Geometry

Array = NDArray[np.float64]

# Angles (psi, theta, phi) turn about (z, y, x).
AXIS_OF_ANGLE = (2, 1, 0)


@dataclass(frozen=True)
class RigidPlate:
    """The plate in its n free coordinates: M, D, K (n, n), B (cells, n), c (cells,) [N/m], F (n, 6) for Fx .. Mz."""

    M: Array
    D: Array
    K: Array
    B: Array
    c: Array
    F: Array


def displacement(arm: Array) -> Array:
    """[I, R] (3, 6): motion per unit q of a point at `arm` (xi, eta, zeta) [m] from the centre of gravity (note 1)."""
    xi, eta, zeta = arm
    R = np.array([[-eta, zeta, 0.0], [xi, 0.0, -zeta], [0.0, -xi, eta]])
    return np.hstack([np.eye(3), R])


def rigid_plate(geometry: Geometry) -> RigidPlate:
    """M, D, K = B'CB (note 2), B, c and F of the declared plate, without effects; D is the declared modal damping."""
    free = [FREEDOMS.index(name) for name in geometry.freedom]
    mass = np.array([body.mass for body in geometry.bodies])
    positions = np.array([body.position for body in geometry.bodies])
    centre = mass @ positions / mass.sum()
    M = _mass_matrix(geometry, positions - centre)[np.ix_(free, free)]
    axes = np.array([cell.direction for cell in geometry.cells])
    arms = np.array([cell.position for cell in geometry.cells]) - centre
    B = np.array([axis @ displacement(arm) for axis, arm in zip(axes, arms, strict=True)])[:, free]
    c = np.array([cell.effective_stiffness for cell in geometry.cells])
    K = B.T @ (c[:, None] * B)
    D = _modal_damping(M, K, geometry.damping_ratio)
    return RigidPlate(M, D, K, B, c, _load_matrix(geometry, centre)[free])


def _mass_matrix(geometry: Geometry, arms: Array) -> Array:
    inertia = np.zeros((3, 3))
    for body, r in zip(geometry.bodies, arms, strict=True):
        inertia += body.inertia.tensor() + body.mass * (r @ r * np.eye(3) - np.outer(r, r))
    M = np.zeros((6, 6))
    M[:3, :3] = sum(body.mass for body in geometry.bodies) * np.eye(3)
    M[3:, 3:] = inertia[np.ix_(AXIS_OF_ANGLE, AXIS_OF_ANGLE)]
    return M


def _load_matrix(geometry: Geometry, centre: Array) -> Array:
    """F (6, 6) by virtual work at the hub; with a torque meter Mz goes beside the plate."""
    F = np.zeros((6, 6))
    F[:, :3] = displacement(np.array(geometry.hub) - centre).T
    for angle, axis in enumerate(AXIS_OF_ANGLE):
        F[3 + angle, 3 + axis] = 1.0
    if geometry.torque_meter:
        F[:, COMPONENTS.index("Mz")] = 0.0
    return F


def _modal_damping(M: Array, K: Array, damping_ratio: float) -> Array:
    """D = M Phi diag(2 zeta omega) Phi' M with Phi'M Phi = I."""
    # With M = LL', the symmetric eigenproblem of L^-1 K L^-T has the eigenvectors L' Phi.
    L = np.linalg.cholesky(M)
    symmetric = np.linalg.solve(L, np.linalg.solve(L, K).T)
    omega2, U = np.linalg.eigh(0.5 * (symmetric + symmetric.T))
    MPhi = L @ U
    return np.asarray(MPhi * (2.0 * damping_ratio * np.sqrt(np.maximum(omega2, 0.0))) @ MPhi.T)
