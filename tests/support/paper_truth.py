"""An independent model of the rigid plate (kinetic energy, modal superposition), and its spectral lines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from balance_cli.campaign.rig.components import COMPONENTS, FREEDOMS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.signals.run_spectrum import RunSpectrum


@dataclass(frozen=True)
class Plate:
    """Mass-normalized modes: omega (n,) [rad/s], shapes Phi (n, n), damping ratio; M, K, cell rows B, stiffness, F."""

    geometry: Geometry
    M: np.ndarray
    K: np.ndarray
    B: np.ndarray
    c: np.ndarray
    F: np.ndarray
    omega: np.ndarray
    Phi: np.ndarray

    def cell_forces(self, frequency: np.ndarray) -> np.ndarray:
        """Force in each cell per unit of each of the six hub loads (k, cells, 6), by modal superposition."""
        w = 2 * np.pi * np.asarray(frequency)[:, None]
        zeta = self.geometry.damping_ratio
        modal = 1.0 / (self.omega**2 - w**2 + 2j * zeta * self.omega * w)
        q = (self.Phi * modal[:, None, :]) @ (self.Phi.T @ self.F)
        return self.c[:, None] * (self.B @ q)

    def coefficients(self, merge: np.ndarray, inputs: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """D, K and B_F of eq. (6) for the sensors `merge` (n, cells): in modal terms, P Phi diag() (P Phi)^-1."""
        PPhi = merge @ (self.c[:, None] * self.B) @ self.Phi
        back = np.linalg.inv(PPhi)
        columns = [COMPONENTS.index(name) for name in inputs]
        D = (PPhi * 2 * self.geometry.damping_ratio * self.omega) @ back
        return D, (PPhi * self.omega**2) @ back, PPhi @ self.Phi.T @ self.F[:, columns]


def velocity_rows(arm: np.ndarray) -> np.ndarray:
    """Velocity (3, 6) at an arm from the center of gravity: v + omega x r, with omega = (phi', theta', psi')."""
    rows = np.zeros((3, 6))
    rows[:, :3] = np.eye(3)
    for place, axis in ((5, 0), (4, 1), (3, 2)):
        rows[:, place] = np.cross(np.eye(3)[axis], arm)
    return rows


def make_plate(geometry: Geometry) -> Plate:
    masses = [body.mass for body in geometry.bodies]
    center = np.average([body.position for body in geometry.bodies], axis=0, weights=masses)
    spin = np.zeros((3, 6))
    spin[0, 5] = spin[1, 4] = spin[2, 3] = 1.0
    M = np.zeros((6, 6))
    for body in geometry.bodies:
        J = velocity_rows(np.array(body.position) - center)
        M += body.mass * J.T @ J + spin.T @ body.inertia.tensor() @ spin
    B = np.array([cell.direction @ velocity_rows(np.array(cell.position) - center) for cell in geometry.cells])
    c = np.array([cell.effective_stiffness for cell in geometry.cells])
    F = np.hstack([velocity_rows(np.array(geometry.hub) - center).T, spin.T])
    if geometry.torque_meter:
        F[:, 5] = 0.0
    free = [FREEDOMS.index(name) for name in geometry.freedom]
    M, B, F = M[np.ix_(free, free)], B[:, free], F[free]
    K = sum(ci * np.outer(b, b) for ci, b in zip(c, B, strict=True))
    omega2, Phi = eigh(K, M)
    return Plate(geometry, M, K, B, c, F, np.sqrt(omega2), Phi)


def volts_per_newton(geometry: Geometry, channel_name: str, frequency: np.ndarray) -> np.ndarray:
    channel = next(channel for channel in geometry.channels if channel.name == channel_name)
    gain = channel.sensitivity * np.ones(len(frequency), complex)
    if channel.time_constant:
        gain /= 1.0 + 1.0 / (2j * np.pi * frequency * channel.time_constant)
    if channel.lowpass:
        gain *= channel.lowpass / (channel.lowpass + 1j * frequency)
    return gain


def sweep(
    truth: Plate,
    loads: Mapping[str, float],
    frequency: np.ndarray,
    channels: tuple[str, ...] | None = None,
    force_noise: float = 0.0,
    load_noise: float = 0.0,
    seed: int = 0,
    name: str = "",
) -> RunSpectrum:
    """Lines of one run with the given load amplitudes (random phases), with white noise of known power.

    `force_noise` [N] is the rms of each cell's noise, `load_noise` that of each load; noise is circular.
    """
    rng = np.random.default_rng(seed)
    geometry, k = truth.geometry, len(frequency)
    names = channels or tuple(ch.name for ch in geometry.channels if ch.cell)
    columns = [COMPONENTS.index(component) for component in loads]
    phase = np.exp(2j * np.pi * rng.random((k, len(columns))))
    u = phase * np.array(list(loads.values()))
    forces = (truth.cell_forces(frequency)[:, :, columns] @ u[:, :, None])[:, :, 0]
    cell_of = {ch.name: geometry.cell_names.index(str(ch.cell)) for ch in geometry.channels if ch.cell}
    gains = np.stack([volts_per_newton(geometry, channel, frequency) for channel in names], axis=1)
    volts = forces[:, [cell_of[channel] for channel in names]] * gains
    sigma = np.concatenate([np.abs(gains) * force_noise, np.full_like(u.real, load_noise)], axis=1)
    noise = sigma * (rng.standard_normal(sigma.shape) + 1j * rng.standard_normal(sigma.shape)) / np.sqrt(2)
    c = len(names)
    return RunSpectrum(
        run=name or "sweep-" + "-".join(loads),
        channel_names=names,
        components=tuple(loads),
        frequency=frequency,
        channels=volts + noise[:, :c],
        loads=u + noise[:, c:],
        covariance=np.einsum("ki,ij->kij", np.maximum(sigma, 1e-12) ** 2, np.eye(sigma.shape[1])).astype(complex),
        dof=float("inf"),
    )


def sweeps(
    truth: Plate, components: tuple[str, ...], frequency: np.ndarray, seed: int = 0, **more
) -> list[RunSpectrum]:
    """One run for each component, unit loads."""
    return [sweep(truth, {c: 1.0}, frequency, seed=100 * seed + i, **more) for i, c in enumerate(components)]
