"""The forces of the springs at many frequencies from poles and residues, in a third of the time of as many solutions.

A system whose matrices are the same at all frequencies has forces that are sums of R_m / (j omega - s_m) over its 2 n
poles s_m. A loss factor, with which the stiffness grows with frequency, has no such sums.
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from balance_cli.model.system import System, complex_readings, dynamic_stiffness

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

FEWEST_FREQUENCIES = 64
"""From which poles are faster: they take as long as some thirty solutions."""
LARGEST_ERROR = 1e-10
"""Of the largest force of a spring, where sums are compared with solutions: two poles in one place have no such sums,
and rounding grows as their vectors become parallel. Usual are 1e-14."""
COMPARED = 4
"""Frequencies that are compared, besides that nearest to a pole: spread evenly over the others."""
KEPT_SYSTEMS = 4
"""Systems whose poles are kept, one for each speed with a gyroscope: the runs of a batch have one."""


def forces_from_poles(system: System, frequency: Array, spin: float) -> ComplexArray | None:
    """Forces (k, e, 6) of the springs per unit hub load at `frequency` (k,) [Hz] and rotor speed `spin` [Hz].

    None where they are not sums over poles to rounding, or not faster so.
    """
    if len(frequency) < FEWEST_FREQUENCIES or np.min(frequency) <= 0 or _varies_with_frequency(system):
        return None
    modal = _poles_and_residues(system, system.coupled_spin(spin))
    if modal is None:
        return None
    poles, residues = modal
    factors = 1.0 / (2j * np.pi * frequency[:, None] - poles)
    nearest = int(np.argmax(np.max(np.abs(factors), axis=1)))
    compared = np.unique([nearest, *np.linspace(0, len(frequency) - 1, COMPARED).astype(int)])
    e, loads = residues.shape[1:]
    flat = residues.reshape(len(poles), -1)
    exact = solved_forces(system, frequency[compared], spin)
    forces = np.asarray((factors @ flat).reshape(len(frequency), e, loads))
    return forces if _agree(forces[compared], exact) else None


def solved_forces(system: System, frequency: Array, spin: float) -> ComplexArray:
    """The same forces (k, e, 6), from a solution at each frequency."""
    motion = np.linalg.solve(dynamic_stiffness(system.pencil, frequency, spin), system.inputs.value)
    if system.readings_loss.value.any() or system.readings_frequency_stiffness.value.any():
        return np.asarray(complex_readings(system, frequency) @ motion)
    return np.asarray(np.moveaxis(np.tensordot(system.readings.value, motion, (1, 1)), 0, 1))


def _agree(forces: ComplexArray, exact: ComplexArray) -> bool:
    """Whether two forces (k, e, 6) differ by rounding, as seen by each spring: some read forces, others motions."""
    of_load = np.abs(exact).max(axis=(0, 1))
    of_load[of_load == 0] = 1.0
    of_spring = (np.abs(exact) / of_load).max(axis=(0, 2))
    return bool(np.all(np.abs(forces - exact) / of_load <= LARGEST_ERROR * of_spring[:, None]))


def _varies_with_frequency(system: System) -> bool:
    """Whether a part other than j omega and its square does; with damping by a loss factor stiffness and loss do."""
    pencil = (system.pencil.hysteresis, system.pencil.frequency_stiffness)
    return any(part.value.any() for part in (*pencil, system.readings_loss, system.readings_frequency_stiffness))


@functools.lru_cache(maxsize=KEPT_SYSTEMS)
def _poles_and_residues(system: System, spin: float) -> tuple[ComplexArray, ComplexArray] | None:
    """Poles (2 n,) [1/s] and residues (2 n, e, 6) of the forces; None where a coordinate has no mass."""
    pencil, n = system.pencil, len(system.pencil.mass.value)
    size = np.diag(pencil.mass.value)
    if not np.all(size > 0):
        return None
    # Coordinates of unit mass: translations and rotations are then comparable, and eigenvectors far from parallel.
    unit = 1.0 / np.sqrt(size)
    damping = pencil.damping.value + 2 * np.pi * spin * pencil.gyroscopic.value
    parts = [unit[:, None] * part * unit for part in (pencil.stiffness.value, damping)]
    loads = unit[:, None] * system.inputs.value
    try:
        of_mass = np.linalg.solve(unit[:, None] * pencil.mass.value * unit, np.hstack([*parts, loads]))
        K, C, B = of_mass[:, :n], of_mass[:, n : 2 * n], of_mass[:, 2 * n :]
        rate = np.sqrt(np.linalg.norm(K)) + 1e-300  # velocities over it are of the size of motions
        first_order = np.block([[np.zeros((n, n)), rate * np.eye(n)], [-K / rate, -C]])
        poles, vectors = np.linalg.eig(first_order)
        participation = np.linalg.solve(vectors, np.vstack([np.zeros_like(B), B / rate]))
    except np.linalg.LinAlgError:
        return None
    read = system.readings.value * unit @ vectors[:n]
    return np.asarray(poles, complex), np.asarray(read.T[:, :, None] * participation[:, None, :], complex)
