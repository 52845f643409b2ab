"""Equations of motion of the true rig, and their solution on a fine grid of time.

Linear rigs are solved by convolution (exact for band-limited loads); rigs with a nonlinear force by Runge-Kutta steps.
The first coordinates are the six motions of the origin, then the shaft, then whatever an effect brings.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.signal import butter, freqs

from studies.blind.rigs import Rig, cell_rows, cross, eigen, mass_matrix

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Steps of Runge-Kutta per radian of the highest mode: its error per step is below 1e-7.
STEP_ANGLE = 0.12
# Passes over the cells with nonlinear forces at rest: one cell takes two, several converge like a Gauss-Seidel method.
MOST_SWEEPS = 200


@dataclass(frozen=True)
class Law:
    """A force beside a cell: `force(elongation, state)` and, with memory, what becomes of the state in a step.

    `damping(rate)` is a force of the rate of elongation, which vanishes at rest.
    """

    cell: int
    force: Callable[[Array, Array], Array]
    advance: Callable[[Array, Array], Array] = lambda d, state: state
    damping: Callable[[Array], Array] | None = None


@dataclass(frozen=True)
class Mechanics:
    """M q'' + (D + spin G) q' + (K + cells) q = B loads; `E` has the cells' elongations and the shaft's twist."""

    M: Array
    D: Array
    K: Array
    E: Array
    B: Array
    stiffness: Array
    G: Array
    loss_factor: float = 0.0
    viscous_time: Array | None = None
    """Dashpot over spring of each cell [s], inside it."""
    relaxing: tuple[tuple[Array, float], ...] = ()
    """Stiffness (n, n) of springs in series with dashpots, and the time constant [s] of each."""
    laws: tuple[Law, ...] = field(default=())
    sideways: Array | None = None
    """Stiffness (6, 6) of the plate against what carries the cells, beside them; no channel reads it."""
    floor: Array | None = None
    """Motion (6, n) of what carries the cells; None where it is the ground."""

    @property
    def springs(self) -> Array:
        """Stiffness (n, n) beside that of the cells and shafts."""
        if self.sideways is None:
            return self.K
        relative = np.eye(6, self.size) - (0.0 if self.floor is None else self.floor)
        return self.K + relative.T @ self.sideways @ relative

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.M)

    @property
    def slowest_decay(self) -> float:
        """Decay rate [1/s] of the slowest mode."""
        A = self.state_matrix(0.0)
        return float(np.min(-np.linalg.eigvals(A).real))

    def state_matrix(self, spin: float) -> Array:
        """Matrix of the state [q, q'] without nonlinear forces."""
        K = self.springs + (self.E.T * self.stiffness) @ self.E
        low = np.hstack([-np.linalg.solve(self.M, K), -np.linalg.solve(self.M, self.D + spin * self.G)])
        return np.vstack([np.hstack([np.zeros((self.size, self.size)), np.eye(self.size)]), low])

    def responses(self, frequency: Array, spin: float) -> ComplexArray:
        """Cell forces and shaft torque per unit load (k, n, 6) at frequencies [Hz]."""
        w = 2 * np.pi * frequency
        law = np.outer(1 + 1j * self.loss_factor * (w > 0), np.ones(len(self.stiffness)))
        if self.viscous_time is not None:
            law = law + 1j * np.outer(w, self.viscous_time)
        Z = -(w[:, None, None] ** 2) * self.M + 1j * w[:, None, None] * (self.D + spin * self.G)
        force = law[:, :, None] * (self.stiffness[:, None] * self.E)
        Z = Z + self.springs + self.E.T @ force
        for stiffness, time in self.relaxing:
            Z = Z + (1j * w * time / (1 + 1j * w * time))[:, None, None] * stiffness
        return np.asarray(force @ np.linalg.solve(Z, np.broadcast_to(self.B, (len(w), *self.B.shape))))


def plate_mechanics(rig: Rig) -> Mechanics:
    """The rig without effects; a shaft beside the plate where there is a torque meter."""
    M = mass_matrix(rig.mass, rig.cg, rig.inertia)
    w, shape = eigen(rig)
    D = M @ shape @ np.diag(2 * rig.damping_ratio * w) @ shape.T @ M
    B = np.vstack([np.hstack([np.eye(3), np.zeros((3, 3))]), np.hstack([cross(rig.hub), np.eye(3)])])
    E, k = cell_rows(rig.position, rig.axis), rig.stiffness
    G = np.zeros((6, 6))
    mechanics = Mechanics(M, D, np.zeros((6, 6)), E, B, k, G)
    if rig.torque is None:
        return mechanics
    stiffness, inertia, ratio = rig.torque
    mechanics = add_coordinate(mechanics, inertia, 2 * ratio * np.sqrt(stiffness * inertia), 0.0)
    B = mechanics.B.copy()
    B[:, 5] = np.eye(7)[6]
    twist = np.eye(7)[6:]
    return replace(mechanics, B=B, E=np.vstack([mechanics.E, twist]), stiffness=np.append(k, stiffness))


def add_coordinate(mechanics: Mechanics, mass: float, damping: float, stiffness: float) -> Mechanics:
    """One more coordinate, not yet coupled to the others."""

    def grown(matrix: Array, value: float) -> Array:
        return np.block([[matrix, np.zeros((len(matrix), 1))], [np.zeros((1, len(matrix))), np.array([[value]])]])

    return replace(
        mechanics,
        M=grown(mechanics.M, mass),
        D=grown(mechanics.D, damping),
        K=grown(mechanics.K, stiffness),
        G=grown(mechanics.G, 0.0),
        E=np.pad(mechanics.E, ((0, 0), (0, 1))),
        B=np.pad(mechanics.B, ((0, 1), (0, 0))),
        floor=None if mechanics.floor is None else np.pad(mechanics.floor, ((0, 0), (0, 1))),
    )


def anti_alias(rig: Rig, frequency: Array) -> ComplexArray:
    """Response of the anti-alias filter."""
    b, a = butter(rig.filter_order, 2 * np.pi * rig.filter_cutoff, analog=True)
    return np.asarray(freqs(b, a, 2 * np.pi * frequency)[1])


def linear_forces(mechanics: Mechanics, loads: Array, rate: float, spin: float, band: float) -> Array:
    """Cell forces (m, n) under loads (m, 6) that repeat; no load above `band` [Hz]."""
    frequency = np.fft.rfftfreq(len(loads), 1 / rate)
    spectrum = np.fft.rfft(loads, axis=0)
    result = np.zeros((len(frequency), len(mechanics.E)), complex)
    used = np.flatnonzero(frequency <= band)
    for part in np.array_split(used, max(1, len(used) // 5000)):
        result[part] = np.einsum("knc,kc->kn", mechanics.responses(frequency[part], spin), spectrum[part])
    return np.asarray(np.fft.irfft(result, len(loads), axis=0))


def nonlinear_forces(mechanics: Mechanics, loads: Array, rate: float, start: Array) -> Array:
    """Cell forces (m, r, n) of runs at rest at `start` (r, n) at first, under loads (2 m, r, 6) given at half steps.

    Runge-Kutta of fourth order.
    """
    A, n = mechanics.state_matrix(0.0).T, mechanics.size
    inverse = np.linalg.inv(mechanics.M)
    into = np.hstack([np.zeros((6, n)), (inverse @ mechanics.B).T])
    pull = [np.concatenate([np.zeros(n), -inverse @ mechanics.E[law.cell]]) for law in mechanics.laws]
    rows = [np.concatenate([mechanics.E[law.cell], np.zeros(n)]) for law in mechanics.laws]
    rates = [np.roll(row, n) for row in rows]
    h, x = 1 / rate, np.hstack([start, np.zeros_like(start)])
    states = [np.zeros(len(x)) for _ in mechanics.laws]

    def slope(x: Array, u: Array) -> Array:
        result = x @ A + u
        for law, row, rate, p, state in zip(mechanics.laws, rows, rates, pull, states, strict=True):
            force = law.force(x @ row, state)
            if law.damping is not None:
                force = force + law.damping(x @ rate)
            result += np.multiply.outer(force, p)
        return result

    out = np.empty((len(loads) // 2, len(x), n))
    for i in range(len(out)):
        out[i] = x[:, :n]
        u0, u1, u2 = loads[2 * i] @ into, loads[2 * i + 1] @ into, loads[min(2 * i + 2, len(loads) - 1)] @ into
        k1 = slope(x, u0)
        k2 = slope(x + h / 2 * k1, u1)
        k3 = slope(x + h / 2 * k2, u1)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(x + h * k3, u2))
        states = [law.advance(x @ row, s) for law, row, s in zip(mechanics.laws, rows, states, strict=True)]
    return np.asarray(out @ mechanics.E.T * mechanics.stiffness)


def equilibria(mechanics: Mechanics, loads: Array) -> Array:
    """Coordinates (m, n) at rest under loads (m, 6), applied one after the other."""
    K = mechanics.springs + (mechanics.E.T * mechanics.stiffness) @ mechanics.E
    rows = mechanics.E[[law.cell for law in mechanics.laws]]
    compliance = np.linalg.solve(K, rows.T)
    states = [np.zeros(1) for _ in mechanics.laws]
    out = []
    for load in loads:
        q = np.linalg.solve(K, mechanics.B @ load)
        if states:
            d = _elongations(mechanics, rows @ q, rows @ compliance, states)
            q = q - compliance @ _law_forces(mechanics, d, states)
            states = [law.advance(d[i : i + 1], states[i]) for i, law in enumerate(mechanics.laws)]
        out.append(q)
    return np.array(out)


def _law_forces(mechanics: Mechanics, d: Array, states: list[Array]) -> Array:
    return np.array([law.force(d[i : i + 1], states[i])[0] for i, law in enumerate(mechanics.laws)])


def _elongations(mechanics: Mechanics, linear: Array, compliance: Array, states: list[Array]) -> Array:
    """Elongations of the cells with nonlinear forces; `linear` are those without these forces.

    The forces grow with the elongation, so that the energy is convex: its minimum along one cell after the other
    converges, and the force relieves each cell by less than it would without that relief. (Powell's method stopped at
    the kinks of a contact, up to 2.6 % of the largest elongation off.)
    """
    cells = np.array([law.cell for law in mechanics.laws])
    d = linear.copy()
    for _ in range(MOST_SWEEPS):
        before = d.copy()
        for cell in dict.fromkeys(cells):
            own = cells == cell
            i = int(np.argmax(own))
            f = _law_forces(mechanics, d, states)
            free = float(linear[i] - compliance[i, ~own] @ f[~own])

            def residual(x: float, own: Array = own, i: int = i, free: float = free) -> float:
                f = _law_forces(mechanics, np.where(own, x, d), states)
                return float(x - free + compliance[i, i] * f[own].sum())

            reach = residual(free)
            # Next to nothing is left of a cubic force near zero: rounding takes it off the elongation.
            moves = free - 2 * reach != free
            d[own] = brentq(residual, free - 2 * reach, free, xtol=1e-13 * abs(reach)) if moves else free
        if np.all(np.abs(d - before) <= 1e-12 * np.abs(d).max()):
            return d
    raise ArithmeticError("no equilibrium")


def static_forces(mechanics: Mechanics, loads: Array) -> Array:
    """Cell forces (m, n) under loads (m, 6) at rest, applied one after the other."""
    return np.asarray(equilibria(mechanics, loads) @ mechanics.E.T * mechanics.stiffness)
