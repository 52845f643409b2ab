"""The rigid plate of the paper's section 3: the matrices M, B, C, K and F of lumped masses, cells and hub.

Coordinates are q = (x, y, z, psi, theta, phi): motion of the center of gravity of the metric side, axes parallel to
the rig's, psi about z, theta about y, phi about x, small angles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import FREEDOMS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.kinematics import ROTATION_ORDER, elongation_matrix, motion_at
from balance_cli.campaign.rig.mass_properties import metric_side
from balance_cli.model.damping import modal_damping
from balance_cli.model.mechanics.dual_numbers import constant

Array = NDArray[np.float64]


def mass_matrix(mass: float, inertia: Array) -> Array:
    """M (6, 6) about the center of gravity: diag(m, m, m) and the inertia tensor in the order psi, theta, phi."""
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = mass * np.eye(3)
    matrix[3:, 3:] = ROTATION_ORDER @ inertia @ ROTATION_ORDER.T
    return matrix


def load_matrix(geometry: Geometry, center: Array) -> Array:
    """F (6, 6): generalized forces per unit hub load (Fx .. Mz), by virtual work.

    A moment that goes through a torque meter acts on the shaft and not on the plate.
    """
    at_hub = motion_at(np.asarray(geometry.hub, float) - center)
    forces = at_hub.T
    moments = np.vstack([np.zeros((3, 3)), ROTATION_ORDER])
    for meter in geometry.shaft_meters:
        moments[:, "xyz".index(meter.axis)] = 0.0
    return np.hstack([forces, moments])


def free_index(geometry: Geometry) -> list[int]:
    """Which of the six coordinates can move."""
    return [FREEDOMS.index(name) for name in geometry.freedom]


def cell_stiffness(geometry: Geometry) -> Array:
    """Stiffness (cells,) of each cell along its axis [N/m]; cell and beam in series where declared so."""
    return np.array([cell.effective_stiffness for cell in geometry.cells])


@dataclass(frozen=True)
class PlateMatrices:
    """The rigid plate in its free coordinates: M, D, K (n, n), B (cells, n), C (cells,) [N/m], F (n, 6)."""

    freedom: tuple[str, ...]
    M: Array
    D: Array
    K: Array
    B: Array
    C: Array
    F: Array


def plate_matrices(geometry: Geometry) -> PlateMatrices:
    """M, D, K = B'CB, B, C and F of the declared plate; D is the declared modal damping.

    Source: docs/theory/paper-notes.md, notes 1 and 2.
    """
    part, free = metric_side(geometry), free_index(geometry)
    M = mass_matrix(part.mass, part.inertia)[np.ix_(free, free)]
    B = elongation_matrix(geometry, part.centre_of_gravity)[:, free]
    C = cell_stiffness(geometry)
    F = load_matrix(geometry, part.centre_of_gravity)[free]
    K = B.T @ (C[:, None] * B)
    zeta = constant(np.full(len(free), geometry.modal_damping_ratio), 0)
    D = modal_damping(constant(M, 0), constant(K, 0), zeta).value
    return PlateMatrices(geometry.freedom, M, D, K, B, C, F)


LEAST_HEIGHT_SHARE = 0.1
"""Height of the hub, over its distance from the origin, below which the rotor stands beside the plate: a tail rotor on
an axis along y. Its height may be millimeters, or zero, and does not show the size of the rig."""


def moment_reference_length(hub: Sequence[float]) -> float:
    """Length [m] that makes moments comparable with forces: the height of the hub above the plate.

    For a hub beside the plate it is the distance from the origin, and 1 m for one at the origin.
    """
    height, distance = abs(float(hub[2])), float(np.linalg.norm(hub))
    return height if height > LEAST_HEIGHT_SHARE * distance else distance or 1.0
