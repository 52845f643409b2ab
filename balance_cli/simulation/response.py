"""Forces of cells and shaft under hub loads, as a linear system in modal form."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.simulation.integrate import ModalSystem, modal_system
from balance_cli.simulation.mechanics import Mechanics

Array = NDArray[np.float64]


def state_matrix(mechanics: Mechanics) -> Array:
    """A (2n+b, 2n+b) of the state `(q, q', w)`, w the dashpots' elongations: `w' = (row q - w) / tau`."""
    n, rows = mechanics.size, _branch_rows(mechanics)
    b = len(rows)
    springs = np.array([branch.stiffness for branch in mechanics.branches])
    rates = np.array([1 / branch.time_constant for branch in mechanics.branches])
    stiffness = mechanics.total_stiffness() + rows.T @ (springs[:, None] * rows)
    A = np.zeros((2 * n + b, 2 * n + b))
    A[:n, n : 2 * n] = np.eye(n)
    A[n : 2 * n] = np.linalg.solve(mechanics.mass, np.hstack([-stiffness, -mechanics.damping, rows.T * springs]))
    A[2 * n :, :n] = rates[:, None] * rows
    A[2 * n :, 2 * n :] = -np.diag(rates)
    return A


def _branch_rows(mechanics: Mechanics) -> Array:
    return np.array([branch.row for branch in mechanics.branches]).reshape(-1, mechanics.size)


def input_matrix(mechanics: Mechanics) -> Array:
    """B (2n+b, 6+m): the hub loads, and the m nonlinear cell forces, which act against the elongation."""
    n = mechanics.size
    pulls = -mechanics.cell_rows[[force.cell for force in mechanics.forces]].T
    B = np.zeros((2 * n + len(mechanics.branches), 6 + len(mechanics.forces)))
    B[n : 2 * n] = np.linalg.solve(mechanics.mass, np.hstack([mechanics.loads, pulls]))
    return B


def force_matrix(mechanics: Mechanics) -> Array:
    """C (c+t, 2n+b): the force of every cell, with its own branches but no nonlinear force, then the torques."""
    n = mechanics.size
    cells = len(mechanics.cell_rows)
    C = np.zeros((cells + len(mechanics.torque_rows), 2 * n + len(mechanics.branches)))
    C[:cells, :n] = mechanics.cell_stiffness[:, None] * mechanics.cell_rows
    if mechanics.cell_damping is not None:
        C[:cells, n : 2 * n] = mechanics.cell_damping[:, None] * mechanics.cell_rows
    C[cells:, :n] = mechanics.torque_rows
    for i, branch in enumerate(mechanics.branches):
        if branch.cell is not None:
            C[branch.cell, :n] += branch.stiffness * branch.row
            C[branch.cell, 2 * n + i] -= branch.stiffness
    return C


def motion_matrix(mechanics: Mechanics) -> Array:
    """Rows (m or 2m, 2n+b): elongation of the cell of every nonlinear force, then the rates of these where needed."""
    n, b = mechanics.size, len(mechanics.branches)
    rows = mechanics.cell_rows[[force.cell for force in mechanics.forces]]
    elongations = np.pad(rows, ((0, 0), (0, n + b)))
    return np.vstack([elongations, np.roll(elongations, n, axis=1)]) if mechanics.needs_rates else elongations


def full_system(mechanics: Mechanics) -> ModalSystem:
    """Cell forces, torques, accelerations and motions (c+t+a+m or 2m) from hub loads and m nonlinear forces (6+m)."""
    A, B = state_matrix(mechanics), input_matrix(mechanics)
    n, rows = mechanics.size, mechanics.accelerometer_rows.reshape(-1, mechanics.size)
    forces, motions = force_matrix(mechanics), motion_matrix(mechanics)
    direct = np.zeros((len(forces) + len(rows) + len(motions), B.shape[1]))
    direct[len(forces) : len(forces) + len(rows)] = rows @ B[n : 2 * n]
    return modal_system(A, B, np.vstack([forces, rows @ A[n : 2 * n], motions]), direct)


def forces_read_by_channels(mechanics: Mechanics, extra: Array) -> Array:
    """The part (n, c+t+a) of the nonlinear forces (n, m) that the cells' channels read beside their linear force."""
    read_by_channels = np.zeros((len(extra), mechanics.sensors))
    for force, column in zip(mechanics.forces, extra.T, strict=True):
        if force.read_by_channels:
            read_by_channels[:, force.cell] += column
    return read_by_channels
