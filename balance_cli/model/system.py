"""The balance at one parameter vector: frequency response of every channel, and its derivatives.

With A(w) = K + j H + j w (D + Omega G) - w^2 M the springs' forces are f = (R + j L) A^-1 F u, R = k E and L = k eta E,
and the channels' volts y = X g(w) f. A change of parameters changes y by
X g (d(R + jL) x + (R + jL) A^-1 (dF u - dA x)) + d(X g) f with x = A^-1 F u: one solution with A serves all parameters.
H and L are those of motion; at rest there is neither (their sign is that of the frequency).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.model.channel_gains import channel_gains, log_gain_slope, path_parameters
from balance_cli.model.mechanics.dual_numbers import Jet
from balance_cli.model.mechanics.equations import CellForce, ChannelPath, Equations, Pickup

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]


REFERENCE = 20.0
"""Frequency [Hz] at which a spring that stiffens with frequency has its own stiffness."""


@dataclass(frozen=True)
class Pencil:
    """A(w) = stiffness + j hysteresis + ln(w / w0) stiffening + j w (damping + Omega gyroscopic) - w^2 mass.

    Each (n, n) with slopes; hysteresis and stiffening only where there is motion; w0 / (2 pi) is `REFERENCE`.
    """

    mass: Jet
    damping: Jet
    gyroscopic: Jet
    stiffness: Jet
    hysteresis: Jet
    stiffening: Jet


@dataclass(frozen=True)
class System:
    """An evaluated balance, all with slopes: pencil, inputs (n, 6), channel paths, spill and mixing;

    readings R = k E (e, n), readings_loss k eta E (e, n), what of the forces is in quadrature, and readings_stiffening,
    what they gain with frequency; reactions (n, e) of the balance to a force along each spring; stiffness, loss and
    stiffening (e,) of the springs; row_factor and own_stiffness (n,), cell forces, pickups and offsets as in the
    equations.
    """

    coordinates: tuple[str, ...]
    pencil: Pencil
    inputs: Jet
    readings: Jet
    readings_loss: Jet
    readings_stiffening: Jet
    reactions: Jet
    stiffness: Jet
    loss: Jet
    stiffening: Jet
    paths: tuple[ChannelPath, ...]
    spill: Jet
    mixing: Jet
    row_factor: Array
    own_stiffness: Array
    channel_offset: Jet
    load_offset: Jet
    forces: tuple[CellForce, ...]
    pickups: tuple[Pickup, ...]

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels in order."""
        return tuple(path.channel for path in self.paths)

    @property
    def parameters(self) -> int:
        """Number p of parameters."""
        return self.inputs.parameters


def assembled(equations: Equations) -> System:
    """Form the pencil, rows of flexible parts by their compliance.

    K = E' diag(k) E + K_extra, H = E' diag(k eta) E, and the same with the stiffening in the place of eta.
    """
    E, k = equations.elongation, equations.stiffness
    springs = k.expanded(-1) * E
    springs_loss = equations.loss.expanded(-1) * springs
    springs_stiffening = equations.stiffening.expanded(-1) * springs
    factor = equations.row_factor.expanded(-1)
    pencil = Pencil(
        mass=factor * equations.mass,
        damping=factor * equations.damping,
        gyroscopic=factor * equations.gyroscopic,
        stiffness=factor * (E.T @ springs + equations.extra_stiffness) + np.diag(equations.own_stiffness),
        hysteresis=factor * (E.T @ springs_loss),
        stiffening=factor * (E.T @ springs_stiffening),
    )
    return System(
        coordinates=equations.coordinates,
        pencil=pencil,
        inputs=factor * equations.inputs,
        readings=springs + equations.extra_readings,
        readings_loss=springs_loss,
        readings_stiffening=springs_stiffening,
        reactions=-(factor * E.T),
        stiffness=k,
        loss=equations.loss,
        stiffening=equations.stiffening,
        paths=equations.paths,
        spill=equations.spill,
        mixing=equations.mixing,
        row_factor=equations.row_factor.value,
        own_stiffness=equations.own_stiffness,
        channel_offset=equations.channel_offset,
        load_offset=equations.load_offset,
        forces=equations.forces,
        pickups=equations.pickups,
    )


@dataclass(frozen=True)
class Solution:
    """What a system gives at k frequencies, before any load is applied.

    to_forces (k, e, n), the readings times A^-1; forces (k, e, 6) per unit hub load; gains (k, c) volts per unit of a
    spring's force.
    """

    frequency: Array
    spin: float
    to_forces: ComplexArray
    inverse: ComplexArray
    forces: ComplexArray
    gains: ComplexArray


def rise(frequency: Array) -> Array:
    """ln(f / f0) (k,) of frequencies [Hz], by which a spring with loss stiffens; zero at rest."""
    moving = np.asarray(frequency, float) > 0
    return np.where(moving, np.log(np.where(moving, frequency, 1.0) / REFERENCE), 0.0)


def dynamic_stiffness(pencil: Pencil, frequency: Array, spin: float = 0.0) -> ComplexArray:
    """A (k, n, n) at `frequency` (k,) [Hz] and rotor speed `spin` [Hz]."""
    w = (2 * np.pi * np.asarray(frequency, float))[:, None, None]
    damping = pencil.damping.value + 2 * np.pi * spin * pencil.gyroscopic.value
    stiffness = pencil.stiffness.value + 1j * np.sign(w) * pencil.hysteresis.value
    stiffness = stiffness + rise(frequency)[:, None, None] * pencil.stiffening.value
    return np.asarray(stiffness + 1j * w * damping - w**2 * pencil.mass.value)


def solve(system: System, frequency: Array, spin: float = 0.0) -> Solution:
    """Invert the dynamic stiffness once; responses and derivatives follow from it."""
    frequency = np.atleast_1d(np.asarray(frequency, float))
    inverse = np.asarray(np.linalg.inv(dynamic_stiffness(system.pencil, frequency, spin)), complex)
    moving = np.sign(frequency)[:, None, None]
    readings = system.readings.value + 1j * moving * system.readings_loss.value
    readings = readings + rise(frequency)[:, None, None] * system.readings_stiffening.value
    to_forces = np.asarray(readings @ inverse, complex)
    forces = np.asarray(to_forces @ system.inputs.value, complex)
    return Solution(frequency, spin, to_forces, inverse, forces, channel_gains(system.paths, frequency))


def response(system: System, solution: Solution) -> ComplexArray:
    """T (k, c, 6): volts per unit hub load, as true loads at the hub (no spill of an exciter)."""
    springs = [path.spring for path in system.paths]
    volts = solution.gains[:, :, None] * solution.forces[:, springs]
    return np.asarray(system.mixing.value @ volts)


@dataclass(frozen=True)
class SpringInputs:
    """Forces along the springs at K lines besides those of the linear balance: `acting` (K, e) on it, and `read` (K, e)

    by the channels of each spring.
    """

    acting: ComplexArray
    read: ComplexArray


def spring_forces(
    system: System, solution: Solution, index: Index, loads: ComplexArray, extra: SpringInputs | None = None
) -> ComplexArray:
    """Forces (K, e) of the springs for loads (K, 6), and further forces along them, at lines `index` (K,)."""
    forces = np.asarray(np.matmul(solution.forces[index], loads[:, :, None])[:, :, 0])
    return forces if extra is None else forces + extra_forces(system, solution, index, extra)


def extra_forces(system: System, solution: Solution, index: Index, extra: SpringInputs) -> ComplexArray:
    """The part (K, e) of the springs' forces, as read, that is due to the further ones."""
    through = (solution.to_forces @ system.reactions.value)[index]
    return np.asarray(np.matmul(through, extra.acting[:, :, None])[:, :, 0] + extra.read)


def volts_of_forces(system: System, solution: Solution) -> tuple[ComplexArray, ComplexArray]:
    """Volts (k, c, e) per unit of a force that acts along each spring, and of one that its channels read."""
    springs = [path.spring for path in system.paths]
    gains, mixing = solution.gains[:, :, None], system.mixing.value
    acting = gains * (solution.to_forces @ system.reactions.value)[:, springs]
    read = gains * np.eye(len(system.stiffness.value))[springs]
    return np.asarray(mixing @ acting), np.asarray(mixing @ read)


def force_slopes(
    system: System,
    solution: Solution,
    index: Index,
    loads: ComplexArray,
    extra: SpringInputs | None = None,
    chosen: NDArray[np.bool_] | slice = slice(None),
) -> ComplexArray:
    """Derivatives (K, e, p) of the spring forces for given loads (K, 6) and further forces at lines `index` (K,)."""
    pencil = system.pencil
    w = 2 * np.pi * solution.frequency[index][:, None]
    driven = loads @ system.inputs.value.T
    if extra is not None:
        driven = driven + extra.acting @ system.reactions.value.T
    x = np.matmul(solution.inverse[index], driven[:, :, None])[:, :, 0]
    lagging, rising = 1j * np.sign(w) * x, rise(solution.frequency[index])[:, None] * x
    damping = pencil.damping.slope + 2 * np.pi * solution.spin * pencil.gyroscopic.slope
    matrices = [system.inputs.slope, -pencil.stiffness.slope, -damping, pencil.mass.slope, -pencil.hysteresis.slope]
    vectors = [loads, x, 1j * w * x, w**2 * x, lagging]
    lossy = system.readings_loss.slope.any()
    if lossy:
        matrices, vectors = [*matrices, -pencil.stiffening.slope], [*vectors, rising]
    change = slopes_times(np.concatenate([part[chosen] for part in matrices], axis=2), np.concatenate(vectors, axis=1))
    if extra is not None:
        change += slopes_times(system.reactions.slope[chosen], extra.acting)
    slopes = solution.to_forces[index] @ change + slopes_times(system.readings.slope[chosen], x)
    if lossy:
        slopes += slopes_times(system.readings_loss.slope[chosen], lagging)
        slopes += slopes_times(system.readings_stiffening.slope[chosen], rising)
    return np.asarray(slopes)


def slopes_times(slopes: Array, vectors: ComplexArray) -> ComplexArray:
    """Slopes (p, a, b) times vectors (K, b), as one matrix product: (K, a, p)."""
    p, a, b = slopes.shape
    flat = slopes.transpose(2, 1, 0).reshape(b, a * p)
    return np.asarray((vectors @ flat).reshape(len(vectors), a, p))


def output_slopes(
    system: System, solution: Solution, index: Index, loads: ComplexArray, extra: SpringInputs | None = None
) -> ComplexArray:
    """Derivatives (K, c, p) of the channels' volts for loads (K, 6) at lines `index` (K,) of the solution.

    Further forces along the springs are taken as given; what they change by themselves is added elsewhere. Each kind
    of slope is formed for the parameters that have it: most have one kind alone.
    """
    springs = [path.spring for path in system.paths]
    forces = spring_forces(system, solution, index, loads, extra)
    gains = solution.gains[index]
    volts = gains * forces[:, springs]
    moving = unless_most(moving_parameters(system))
    slopes = np.zeros((len(index), len(springs), system.parameters), complex)
    slopes[:, :, moving] = gains[:, :, None] * force_slopes(system, solution, index, loads, extra, moving)[:, springs]
    s = np.asarray(2j * np.pi * solution.frequency[:, None], np.complex128)
    for c, path in enumerate(system.paths):
        own = path_parameters(path)
        if own.any():
            slopes[:, c, own] += np.asarray(volts[:, c, None] * log_gain_slope(path, s)[:, own][index])
    if np.any(system.mixing.value != np.eye(len(springs))):
        slopes = system.mixing.value @ slopes
    mixed = system.mixing.slope.any(axis=(1, 2))
    if mixed.any():
        slopes[:, :, mixed] += slopes_times(system.mixing.slope[mixed], volts)
    return np.asarray(slopes)


def moving_parameters(system: System) -> NDArray[np.bool_]:
    """Which parameters (p,) change the forces of the springs; those of channels and exciters do not."""
    pencil = system.pencil
    parts = (pencil.mass, pencil.damping, pencil.gyroscopic, pencil.stiffness, pencil.hysteresis, pencil.stiffening)
    read = (system.readings, system.readings_loss, system.readings_stiffening)
    every = (*parts, *read, system.inputs, system.reactions)
    return np.asarray(np.any([part.slope.any(axis=(1, 2)) for part in every], axis=0))


def unless_most(chosen: NDArray[np.bool_]) -> NDArray[np.bool_] | slice:
    """The chosen parameters (p,), or all where they are most: a part of the last axis is slow to reach."""
    return chosen if 2 * np.count_nonzero(chosen) < len(chosen) else slice(None)
