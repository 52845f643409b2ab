"""Derivatives of the frequency response by all parameters.

A change of parameters changes y = X g f by X g (dR x + R A^-1 (dF u - dA x)) + d(X g) f with x = A^-1 F u: one solution
with A serves all parameters.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.model.channel_gains import log_gain_derivative, path_parameters
from balance_cli.model.system import System
from balance_cli.model.system_response import Solution, SpringInputs, spring_forces

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]
Selection = Mask | slice

MAX_READING_SHARE = 0.2
"""Share of the channels' derivatives above which all are computed as one matrix product: picking them costs as much."""


def multiply_derivatives(derivatives: Array, vectors: ComplexArray) -> ComplexArray:
    """Derivatives (p, a, b) times vectors (K, b), as one matrix product: (K, a, p)."""
    p, a, b = derivatives.shape
    flat = derivatives.transpose(2, 1, 0).reshape(b, a * p)
    return np.asarray((vectors @ flat).reshape(len(vectors), a, p))


def _force_volts_jacobian(
    system: System,
    solution: Solution,
    index: Index,
    loads: ComplexArray,
    extra: SpringInputs | None,
    selection: Selection,
) -> ComplexArray:
    """Derivatives (K, c, p) of the volts by way of the springs' forces, for given gains and before mixing."""
    x, change = _motion_and_change(system, solution, index, loads, extra, selection)
    springs, gains = system.springs_of_channels, solution.gains
    matrices, vectors = [system.readings.derivative], [x]
    if system.readings_loss.derivative.any():
        frequency = solution.frequency[index][:, None]
        matrices += [system.readings_loss.derivative, system.readings_frequency_stiffness.derivative]
        vectors += [1j * np.sign(frequency) * x, system.pencil.log_frequency_ratio(frequency) * x]
    of_readings = np.concatenate([part[selection][:, springs] for part in matrices], axis=2)
    derivatives = (gains[:, :, None] * solution.force_influence[:, springs])[index] @ change
    _add_reading_changes(derivatives, of_readings, np.concatenate(vectors, axis=1), gains[index])
    return np.asarray(derivatives)


def _add_reading_changes(
    derivatives: ComplexArray, of_readings: Array, vectors: ComplexArray, gains: ComplexArray
) -> None:
    """Add those of the readings (p, c, b) of vectors (K, b) times gains (K, c) to `derivatives` (K, c, p), in place.

    A stiffness changes the reading of its own spring alone.
    """
    changes = of_readings.any(axis=2)
    if np.count_nonzero(changes) > MAX_READING_SHARE * changes.size:
        derivatives += gains[:, :, None] * multiply_derivatives(of_readings, vectors)
        return
    parameter, channel = np.nonzero(changes)
    derivatives[:, channel, parameter] += gains[:, channel] * (vectors @ of_readings[parameter, channel].T)


def hub_motion_jacobian(system: System, solution: Solution, index: Index, loads: ComplexArray) -> ComplexArray:
    """Derivatives (K, 6, p) of the motion of the hub for given loads (K, 6) at lines `index` (K,)."""
    x, change = _motion_and_change(system, solution, index, loads, None, slice(None))
    rows = system.equations.inputs
    derivatives = (rows.value.T @ solution.receptance)[index] @ change
    return np.asarray(derivatives + multiply_derivatives(rows.derivative.swapaxes(1, 2), x))


def _motion_and_change(
    system: System,
    solution: Solution,
    index: Index,
    loads: ComplexArray,
    extra: SpringInputs | None,
    selection: Selection,
) -> tuple[ComplexArray, ComplexArray]:
    """The motion x (K, n) and the change (K, n, p) of its excitation, dF u - dA x, for the selected parameters."""
    pencil = system.pencil
    w = 2 * np.pi * solution.frequency[index][:, None]
    excitation = loads @ system.inputs.value.T
    if extra is not None:
        excitation = excitation + extra.acting @ system.reactions.value.T
    x = np.matmul(solution.receptance[index], excitation[:, :, None])[:, :, 0]
    ratio = pencil.log_frequency_ratio(solution.frequency[index])[:, None]
    quadrature, logarithmic = 1j * np.sign(w) * x, ratio * x
    matrices = [
        system.inputs.derivative,
        -pencil.stiffness.derivative,
        -pencil.damping_derivative(solution.spin),
        pencil.mass.derivative,
        -pencil.hysteresis.derivative,
    ]
    vectors = [loads, x, 1j * w * x, w**2 * x, quadrature]
    if system.readings_loss.derivative.any():
        matrices, vectors = [*matrices, -pencil.frequency_stiffness.derivative], [*vectors, logarithmic]
    change = multiply_derivatives(
        np.concatenate([part[selection] for part in matrices], axis=2), np.concatenate(vectors, axis=1)
    )
    if extra is not None:
        change += multiply_derivatives(system.reactions.derivative[selection], extra.acting)
    return x, change


def output_jacobian(
    system: System, solution: Solution, index: Index, loads: ComplexArray, extra: SpringInputs | None = None
) -> ComplexArray:
    """Derivatives (K, c, p) of the channels' volts for loads (K, 6) at lines `index` (K,) of the solution.

    Extra forces along the springs are taken as given; their own derivatives are added elsewhere. Each kind of
    derivative is computed only for the parameters that have it: most have a single kind.
    """
    springs, mixing = system.springs_of_channels, system.equations.mixing
    forces = spring_forces(system, solution, index, loads, extra)
    volts = solution.gains[index] * forces[:, springs]
    moving = mask_or_full_slice(system.structural_parameters)
    derivatives = _force_volts_jacobian(system, solution, index, loads, extra, moving)
    if not isinstance(moving, slice):
        of_forces, derivatives = derivatives, np.zeros((*volts.shape, system.parameters), complex)
        derivatives[:, :, moving] = of_forces
    _add_gain_derivatives(derivatives, system, solution, index, volts)
    if np.any(mixing.value != np.eye(len(springs))):
        derivatives = mixing.value @ derivatives
    for channel in range(len(springs)):
        mixed = mixing.derivative[:, channel].any(axis=1)
        if mixed.any():
            derivatives[:, channel, mixed] += volts @ mixing.derivative[mixed, channel].T
    return np.asarray(derivatives)


def _add_gain_derivatives(
    derivatives: ComplexArray, system: System, solution: Solution, index: Index, volts: ComplexArray
) -> None:
    """Add to `derivatives` (K, c, p), in place, those of the channels' own gains, for volts (K, c) before mixing."""
    s = np.asarray(2j * np.pi * solution.frequency[:, None], np.complex128)
    for c, path in enumerate(system.equations.paths):
        own = path_parameters(path)
        if own.any():
            derivatives[:, c, own] += np.asarray(volts[:, c, None] * log_gain_derivative(path, s, own)[index])


def mask_or_full_slice(selection: Mask) -> Selection:
    """The selected parameters (p,), or all of them where most are selected: copying a part of the last axis is slow."""
    return selection if 2 * np.count_nonzero(selection) < len(selection) else slice(None)
