"""Nonlinear cell forces, integrated in time for many records at once, and at rest along a load series.

The linear part of the rig is solved exactly; the nonlinear forces enter it as further inputs, held as polynomials of
third degree through the last three samples and the next, which is found by iteration (an implicit exponential
multistep method; Hochbruck and Ostermann, Acta Numerica 19, 2010, section 2.6).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from balance_cli.io.errors import UserError
from balance_cli.simulation.integrate import ModalSystem, hold_weights
from balance_cli.simulation.mechanics import NonlinearCellForce
from balance_cli.simulation.single_force import Correct, ForceBlocks, integrate_blocks

Array = NDArray[np.float64]

CORRECTOR_ITERATIONS = 2
"""Each reduces the error of the force by a factor of about k h^2 / (10 m), a thousandth for the cells of RTS-6."""
LOAD_SUBSTEPS = 8
"""Load steps between static points: the path decides which contacts slip."""


MOST_SINGLE_RUNS = 6
"""Runs up to which a force that is alone is computed by numbers: more take longer so than as an array."""


class _Arithmetic(NamedTuple):
    """The functions by which forces are computed, those of arrays or of numbers."""

    minimum: Callable[..., Any]
    maximum: Callable[..., Any]
    exp: Callable[..., Any]


_OF_ARRAYS, _OF_NUMBERS = _Arithmetic(np.minimum, np.maximum, np.exp), _Arithmetic(min, max, math.exp)


@dataclass(frozen=True)
class NonlinearForces:
    """The coefficients (m,) of m nonlinear forces, each named as in `NonlinearCellForce`.

    `arithmetic` belongs to these: a `single` force has numbers, and takes and returns numbers.
    """

    k2: Array
    k3: Array
    stick_stiffness: Array
    limit: Array
    asymmetry: Array
    fast_share: Array
    speed: Array
    stop_stiffness: Array
    gap: Array
    c2: Array
    damping_difference: Array
    arithmetic: _Arithmetic = _OF_ARRAYS

    @classmethod
    def from_cell_forces(cls, forces: Sequence[NonlinearCellForce]) -> NonlinearForces:
        """The coefficients of all forces."""
        names = [item.name for item in fields(cls)[:-1]]
        arrays: dict[str, Any] = {name: np.array([getattr(force, name) for force in forces], float) for name in names}
        return cls(**arrays)

    def single(self) -> NonlinearForces:
        """The only force, with its coefficients as numbers, which Python multiplies in a tenth of the time."""
        numbers: dict[str, Any] = {item.name: getattr(self, item.name).item() for item in fields(self)[:-1]}
        return replace(self, **numbers, arithmetic=_OF_NUMBERS)

    # Asked in each step, and looked up once.

    @cached_property
    def has_springs(self) -> bool:
        """Whether a part of any force depends only on the elongation."""
        return bool(np.any(self.k2) or np.any(self.k3) or self.has_stops)

    @cached_property
    def has_stops(self) -> bool:
        """Whether any force has stops."""
        return bool(np.any(self.stop_stiffness))

    @cached_property
    def has_dampers(self) -> bool:
        """Whether a part of any force depends only on the rate."""
        return bool(np.any(self.c2) or np.any(self.damping_difference))

    @cached_property
    def has_falling_friction(self) -> bool:
        """Whether the force of any contact depends on the rate."""
        return bool(np.any(self.fast_share != 1.0))

    @cached_property
    def contact_limits(self) -> tuple[Array, Array]:
        """The least and the largest force of each contact at rest."""
        return self.limit * (self.asymmetry - 1.0), self.limit * (self.asymmetry + 1.0)

    @cached_property
    def falling_share(self) -> tuple[Array, Array]:
        """What falls of a contact's force with its rate, and the factor of the squared rate in the exponent."""
        return 1.0 - self.fast_share, -1.0 / self.speed**2

    def contact(self, d: Array, before: Array, held: Array) -> Array:
        """Contact forces at rest at elongations d that were `before` when the contacts held the forces `held`."""
        return self.slip(held + self.stick_stiffness * (d - before))

    def slip(self, moved: Array) -> Array:
        """Contact forces at rest of contacts that would hold the forces `moved` if they stuck."""
        least, largest = self.contact_limits
        held: Array = self.arithmetic.minimum(self.arithmetic.maximum(moved, least), largest)
        return held

    def spring(self, d: Array) -> Array:
        """The part that depends only on the elongation."""
        force: Array = (self.k2 + self.k3 * d) * d * d
        if self.has_stops:
            force = force + self.stop_stiffness * (
                d - self.arithmetic.minimum(self.arithmetic.maximum(d, -self.gap), self.gap)
            )
        return force

    def total(self, d: Array, rate: Array, contact: Array) -> Array:
        """The forces at elongations and rates, with the contacts' forces at rest."""
        force = contact
        if self.has_falling_friction:
            falling, exponent = self.falling_share
            force = force * (self.fast_share + falling * self.arithmetic.exp(exponent * rate * rate))
        if self.has_springs:
            force = force + self.spring(d)
        if self.has_dampers:
            force = force + abs(rate) * (self.c2 * rate + 0.5 * self.damping_difference)
        return force

    def tangent_stiffness(self, d: Array, before: Array, held: Array) -> Array:
        """Derivative of the total force at rest with respect to d."""
        moved = held + self.stick_stiffness * (d - before)
        sticks = np.abs(moved - self.limit * self.asymmetry) < self.limit
        contacts = np.where(sticks, self.stick_stiffness, 0.0)
        contacts += np.where(np.abs(d) > self.gap, self.stop_stiffness, 0.0)
        tangent_stiffness: Array = (2 * self.k2 + 3 * self.k3 * d) * d + contacts
        return tangent_stiffness


@dataclass(frozen=True)
class RestState:
    """A rig at rest: elongations, whole nonlinear forces and the contact's part of them, (rows, m) each."""

    elongation: Array
    force: Array
    contact: Array


def _equilibrium(forces: NonlinearForces, flexibility: Array, free: Array, before: Array, held: Array) -> Array:
    """Elongations d with `d + flexibility f(d) = free` (Newton). Raises UserError without convergence."""
    d = before
    for _ in range(60):
        residual = d + flexibility @ (forces.spring(d) + forces.contact(d, before, held)) - free
        tangent_stiffness = forces.tangent_stiffness(d, before, held)
        step = np.linalg.solve(np.eye(len(d)) + flexibility * tangent_stiffness, residual)
        d = d - step
        if np.max(np.abs(step)) <= 1e-12 * max(1e-9, float(np.max(np.abs(d)))):
            return d
    raise UserError("the rig has no equilibrium under its load", place="effects", remedy="Reduce the nonlinear force")


def solve_rest_state(forces: NonlinearForces, gain: Array, loads: Array) -> RestState:
    """The rig at rest under `loads` (rows, 6), applied one after another to the unloaded rig.

    `gain` (m, 6+m): static elongations per hub load and per nonlinear force.
    """
    response, flexibility = gain[:, :6], -gain[:, 6:]
    d = held = np.zeros(len(gain))
    free = np.zeros(len(gain))
    rows = []
    for target in loads @ response.T:
        for part in np.arange(1, LOAD_SUBSTEPS + 1) / LOAD_SUBSTEPS:
            after = _equilibrium(forces, flexibility, free + part * (target - free), d, held)
            d, held = after, forces.contact(after, d, held)
        free = target
        rows.append((d, forces.spring(d) + held, held))
    return RestState(*(np.array(column) for column in zip(*rows, strict=True)))


@dataclass(frozen=True)
class _Stepper:
    """One step of the linear rig under nonlinear forces: `[state, e] <- state step + f1 [ahead, reach]`.

    The state is `[z, f0, f-1, f-2]`: z (2p) are the real and imaginary parts of the modal states. e (m or 2m) are the
    elongations that the forces cause, and their rates. `step` (s, s+m or s+2m), `ahead` (m, s), `reach` (m, m or 2m).
    """

    step: Array
    ahead: Array
    reach: Array

    @classmethod
    def from_system(cls, system: ModalSystem, step: float) -> _Stepper:
        offsets = np.array([0, -1, -2, 1])
        decay = np.exp(system.poles * step)
        weights = np.array([hold_weights(pole, step, offsets) for pole in system.poles])
        p, m = system.inputs.shape
        out = np.vstack([system.outputs.real.T, -system.outputs.imag.T])
        states = np.zeros((2 * p + 3 * m, 2 * p))
        turn = np.diag(decay)
        states[: 2 * p] = np.block([[turn.real, turn.imag], [-turn.imag, turn.real]])
        drives = [(weights[:, i, None] * system.inputs).T for i in range(4)]
        real = [np.hstack([drive.real, drive.imag]) for drive in drives]
        states[2 * p :] = np.vstack(real[:3])
        older = np.vstack([np.zeros((2 * p, 3 * m)), np.eye(3 * m, k=m)])  # each force becomes the one before
        newest = np.eye(m, 3 * m)
        return cls(np.hstack([states, older, states @ out]), np.hstack([real[3], newest]), real[3] @ out)


def _equilibrium_states(system: ModalSystem, force: Array) -> Array:
    """Modal states (runs, 2p) in equilibrium under constant forces (runs, m)."""
    modal = -(force @ system.inputs.T) / system.poles
    return np.hstack([modal.real, modal.imag])


def integrate_nonlinear_forces(
    forces: NonlinearForces, system: ModalSystem, start: RestState, linear: Array, step: float
) -> Array:
    """Nonlinear forces (n, runs, m) of several records at once.

    `system` takes these forces to elongations, and to rates where a force needs them; `linear` (n, runs, m or 2m) are
    those under the hub loads alone; `start` is the state of rest (runs, m) from which the records begin.
    """
    stepper = _Stepper.from_system(system, step)
    m, size = stepper.ahead.shape
    state = np.hstack([_equilibrium_states(system, start.force), start.force, start.force, start.force])
    result = np.empty((len(linear), *start.force.shape))
    result[0] = start.force
    if m == 1 and len(start.force) <= MOST_SINGLE_RUNS:
        blocks = ForceBlocks.from_step(stepper.step, stepper.ahead, size)
        result[1:, :, 0] = integrate_blocks(blocks, state, linear[1:], _single_correctors(forces, start, stepper.reach))
        return result
    next_forces = _corrector(forces, start, stepper.reach)
    for k in range(1, len(linear)):
        ahead = np.dot(state, stepper.step)
        result[k] = force = next_forces(ahead[:, size:] + linear[k])
        state = ahead[:, :size] + np.dot(force, stepper.ahead)
    return result


def _corrector(forces: NonlinearForces, start: RestState, reach: Array) -> Callable[[Array], Array]:
    """A function of the motion (runs, m or 2m) without the next forces that returns these forces (runs, m)."""
    d, force, held = start.elongation, start.force, start.contact
    m = len(forces.limit)
    slips, stick = bool(np.any(forces.limit)), forces.stick_stiffness

    def next_forces(base: Array) -> Array:
        nonlocal d, force, held
        stuck = held - stick * d if slips else held
        for _ in range(CORRECTOR_ITERATIONS):
            motion = base + np.dot(force, reach)
            d = motion[:, :m]
            if slips:
                held = forces.slip(stuck + stick * d)
            force = forces.total(d, motion[:, m:], held)
        return force

    return next_forces


def _single_correctors(forces: NonlinearForces, start: RestState, reach: Array) -> list[Correct]:
    """For each of few runs of one force the same function, of its elongation and rate."""
    law, stick, slips = forces.single(), forces.stick_stiffness.item(), bool(np.any(forces.limit))
    total: Callable[..., Any] = law.total
    limits: tuple[Any, Any] = law.contact_limits
    least, largest = limits
    of_elongation, of_rate = [*reach[0].tolist(), 0.0][:2]

    def corrector(d: float, held: float, force: float) -> Correct:
        def next_force(free: float, rate: float) -> float:
            nonlocal d, held, force
            stuck = held - stick * d
            for _ in range(CORRECTOR_ITERATIONS):
                d = free + force * of_elongation
                if slips:
                    held = stuck + stick * d
                    held = least if held < least else largest if held > largest else held  # `slip`, without its calls
                force = total(d, rate + force * of_rate, held)
            return force

        return next_force

    states = np.hstack([start.elongation, start.contact, start.force]).tolist()
    return [corrector(*state) for state in states]
