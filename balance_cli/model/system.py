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

from balance_cli.model.channel_gains import channel_gains, log_gain_derivative, path_parameters
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import CellForce, ChannelPath, Equations, InterferenceTone

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]


REFERENCE_FREQUENCY = 20.0
"""Frequency [Hz] at which a spring that stiffens with frequency has its own stiffness."""


@dataclass(frozen=True)
class Pencil:
    """A(w) = stiffness + j hysteresis + ln(w / w0) stiffening + j w (damping + Omega gyroscopic) - w^2 mass.

    Each (n, n) with slopes; hysteresis and stiffening only where there is motion; w0 / (2 pi) is `REFERENCE_FREQUENCY`.
    """

    mass: Dual
    damping: Dual
    gyroscopic: Dual
    stiffness: Dual
    hysteresis: Dual
    frequency_stiffness: Dual


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
    inputs: Dual
    readings: Dual
    readings_loss: Dual
    readings_frequency_stiffness: Dual
    reactions: Dual
    stiffness: Dual
    loss: Dual
    frequency_stiffness: Dual
    paths: tuple[ChannelPath, ...]
    exciter_cross_axis: Dual
    mixing: Dual
    row_factor: Array
    own_stiffness: Array
    channel_offset: Dual
    load_offset: Dual
    forces: tuple[CellForce, ...]
    interference_tones: tuple[InterferenceTone, ...]

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels in order."""
        return tuple(path.channel for path in self.paths)

    @property
    def parameters(self) -> int:
        """Number p of parameters."""
        return self.inputs.parameters


def assemble_system(equations: Equations) -> System:
    """Form the pencil, rows of flexible parts by their compliance.

    K = E' diag(k) E + K_extra, H = E' diag(k eta) E, and the same with the stiffening in the place of eta.
    """
    E, k = equations.elongation, equations.stiffness
    springs = k.insert_axis(-1) * E
    springs_loss = equations.loss.insert_axis(-1) * springs
    springs_frequency_stiffness = equations.frequency_stiffness.insert_axis(-1) * springs
    factor = equations.row_factor.insert_axis(-1)
    pencil = Pencil(
        mass=factor * equations.mass,
        damping=factor * equations.damping,
        gyroscopic=factor * equations.gyroscopic,
        stiffness=factor * (E.T @ springs + equations.extra_stiffness) + np.diag(equations.own_stiffness),
        hysteresis=factor * (E.T @ springs_loss),
        frequency_stiffness=factor * (E.T @ springs_frequency_stiffness),
    )
    return System(
        coordinates=equations.coordinates,
        pencil=pencil,
        inputs=factor * equations.inputs,
        readings=springs + equations.extra_readings,
        readings_loss=springs_loss,
        readings_frequency_stiffness=springs_frequency_stiffness,
        reactions=-(factor * E.T),
        stiffness=k,
        loss=equations.loss,
        frequency_stiffness=equations.frequency_stiffness,
        paths=equations.paths,
        exciter_cross_axis=equations.exciter_cross_axis,
        mixing=equations.mixing,
        row_factor=equations.row_factor.value,
        own_stiffness=equations.own_stiffness,
        channel_offset=equations.channel_offset,
        load_offset=equations.load_offset,
        forces=equations.forces,
        interference_tones=equations.interference_tones,
    )


@dataclass(frozen=True)
class Solution:
    """What a system gives at k frequencies, before any load is applied.

    to_forces (k, e, n), the readings times A^-1; forces (k, e, 6) per unit hub load; gains (k, c) volts per unit of a
    spring's force.
    """

    frequency: Array
    spin: float
    force_influence: ComplexArray
    receptance: ComplexArray
    forces: ComplexArray
    gains: ComplexArray


def log_frequency_ratio(frequency: Array) -> Array:
    """ln(f / f0) (k,) of frequencies [Hz], by which a spring with loss stiffens; zero at rest."""
    moving = np.asarray(frequency, float) > 0
    return np.where(moving, np.log(np.where(moving, frequency, 1.0) / REFERENCE_FREQUENCY), 0.0)


def dynamic_stiffness(pencil: Pencil, frequency: Array, spin: float = 0.0) -> ComplexArray:
    """A (k, n, n) at `frequency` (k,) [Hz] and rotor speed `spin` [Hz]."""
    w = (2 * np.pi * np.asarray(frequency, float))[:, None, None]
    damping = pencil.damping.value + 2 * np.pi * spin * pencil.gyroscopic.value
    stiffness = pencil.stiffness.value + 1j * np.sign(w) * pencil.hysteresis.value
    stiffness = stiffness + log_frequency_ratio(frequency)[:, None, None] * pencil.frequency_stiffness.value
    return np.asarray(stiffness + 1j * w * damping - w**2 * pencil.mass.value)


def solve(system: System, frequency: Array, spin: float = 0.0) -> Solution:
    """Invert the dynamic stiffness once; responses and derivatives follow from it."""
    frequency = np.atleast_1d(np.asarray(frequency, float))
    receptance = np.asarray(np.linalg.inv(dynamic_stiffness(system.pencil, frequency, spin)), complex)
    moving = np.sign(frequency)[:, None, None]
    readings = system.readings.value + 1j * moving * system.readings_loss.value
    readings = readings + log_frequency_ratio(frequency)[:, None, None] * system.readings_frequency_stiffness.value
    force_influence = np.asarray(readings @ receptance, complex)
    forces = np.asarray(force_influence @ system.inputs.value, complex)
    return Solution(frequency, spin, force_influence, receptance, forces, channel_gains(system.paths, frequency))


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
    through = (solution.force_influence @ system.reactions.value)[index]
    return np.asarray(np.matmul(through, extra.acting[:, :, None])[:, :, 0] + extra.read)


def volts_of_forces(system: System, solution: Solution) -> tuple[ComplexArray, ComplexArray]:
    """Volts (k, c, e) per unit of a force that acts along each spring, and of one that its channels read."""
    springs = [path.spring for path in system.paths]
    gains, mixing = solution.gains[:, :, None], system.mixing.value
    acting = gains * (solution.force_influence @ system.reactions.value)[:, springs]
    read = gains * np.eye(len(system.stiffness.value))[springs]
    return np.asarray(mixing @ acting), np.asarray(mixing @ read)


def spring_force_jacobian(
    system: System,
    solution: Solution,
    index: Index,
    loads: ComplexArray,
    extra: SpringInputs | None = None,
    selection: NDArray[np.bool_] | slice = slice(None),
) -> ComplexArray:
    """Derivatives (K, e, p) of the spring forces for given loads (K, 6) and further forces at lines `index` (K,)."""
    pencil = system.pencil
    w = 2 * np.pi * solution.frequency[index][:, None]
    driven = loads @ system.inputs.value.T
    if extra is not None:
        driven = driven + extra.acting @ system.reactions.value.T
    x = np.matmul(solution.receptance[index], driven[:, :, None])[:, :, 0]
    lagging, rising = 1j * np.sign(w) * x, log_frequency_ratio(solution.frequency[index])[:, None] * x
    damping = pencil.damping.derivative + 2 * np.pi * solution.spin * pencil.gyroscopic.derivative
    matrices = [
        system.inputs.derivative,
        -pencil.stiffness.derivative,
        -damping,
        pencil.mass.derivative,
        -pencil.hysteresis.derivative,
    ]
    vectors = [loads, x, 1j * w * x, w**2 * x, lagging]
    lossy = system.readings_loss.derivative.any()
    if lossy:
        matrices, vectors = [*matrices, -pencil.frequency_stiffness.derivative], [*vectors, rising]
    change = multiply_derivatives(
        np.concatenate([part[selection] for part in matrices], axis=2), np.concatenate(vectors, axis=1)
    )
    if extra is not None:
        change += multiply_derivatives(system.reactions.derivative[selection], extra.acting)
    derivatives = solution.force_influence[index] @ change + multiply_derivatives(
        system.readings.derivative[selection], x
    )
    if lossy:
        derivatives += multiply_derivatives(system.readings_loss.derivative[selection], lagging)
        derivatives += multiply_derivatives(system.readings_frequency_stiffness.derivative[selection], rising)
    return np.asarray(derivatives)


def multiply_derivatives(derivatives: Array, vectors: ComplexArray) -> ComplexArray:
    """Slopes (p, a, b) times vectors (K, b), as one matrix product: (K, a, p)."""
    p, a, b = derivatives.shape
    flat = derivatives.transpose(2, 1, 0).reshape(b, a * p)
    return np.asarray((vectors @ flat).reshape(len(vectors), a, p))


def output_jacobian(
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
    moving = mask_or_full_slice(structural_parameters(system))
    derivatives = np.zeros((len(index), len(springs), system.parameters), complex)
    derivatives[:, :, moving] = (
        gains[:, :, None] * spring_force_jacobian(system, solution, index, loads, extra, moving)[:, springs]
    )
    s = np.asarray(2j * np.pi * solution.frequency[:, None], np.complex128)
    for c, path in enumerate(system.paths):
        own = path_parameters(path)
        if own.any():
            derivatives[:, c, own] += np.asarray(volts[:, c, None] * log_gain_derivative(path, s)[:, own][index])
    if np.any(system.mixing.value != np.eye(len(springs))):
        derivatives = system.mixing.value @ derivatives
    mixed = system.mixing.derivative.any(axis=(1, 2))
    if mixed.any():
        derivatives[:, :, mixed] += multiply_derivatives(system.mixing.derivative[mixed], volts)
    return np.asarray(derivatives)


def structural_parameters(system: System) -> NDArray[np.bool_]:
    """Which parameters (p,) change the forces of the springs; those of channels and exciters do not."""
    pencil = system.pencil
    parts = (
        pencil.mass,
        pencil.damping,
        pencil.gyroscopic,
        pencil.stiffness,
        pencil.hysteresis,
        pencil.frequency_stiffness,
    )
    read = (system.readings, system.readings_loss, system.readings_frequency_stiffness)
    every = (*parts, *read, system.inputs, system.reactions)
    return np.asarray(np.any([part.derivative.any(axis=(1, 2)) for part in every], axis=0))


def mask_or_full_slice(selection: NDArray[np.bool_]) -> NDArray[np.bool_] | slice:
    """The chosen parameters (p,), or all where they are most: a part of the last axis is slow to reach."""
    return selection if 2 * np.count_nonzero(selection) < len(selection) else slice(None)
