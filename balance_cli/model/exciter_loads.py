"""The loads that act for those that the exciters' force cells record, and their derivatives.

A force cell may read `gain` times its load, late by `delay`; a load may follow what is recorded with a lag a, b; and a
`mass` beyond the force cell moves with the hub, and a `stiffness` holds it, along its own axis or another one: with D
the diagonal matrix of the dynamic stiffness s^2 mass + stiffness along each component, summed over the exciters that
are attached in a run, H the motion of the hub per unit load and C the cross-axis matrix,

    e = exp(s delay) / gain / (1 + s a + s^2 b) recorded load,        (1 + D H) v = e,        true load = C v

In static runs weights act, for which there is the matrix of their misalignment alone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.model.mechanics.equations import Equations
from balance_cli.model.response_jacobian import hub_motion_jacobian, multiply_derivatives
from balance_cli.model.system import System
from balance_cli.model.system_response import Solution, hub_motion

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]


def has_plain_exciters(equations: Equations) -> bool:
    """Whether force cells read what acts beyond them: no gain, delay, lag, mass or stiffness at its present value."""
    others = np.any(equations.load_delay.value) or np.any(equations.load_lag.value)
    return np.array_equal(equations.load_gain.value, np.ones(6)) and not (others or exciters_resist_motion(equations))


def exciters_resist_motion(equations: Equations) -> bool:
    """Whether a mass or a stiffness beyond a force cell takes a part of its load where the hub moves."""
    return bool(np.any(equations.exciter_mass.value) or np.any(equations.exciter_stiffness.value))


def attach_exciters(system: System, attached: Mask) -> System:
    """Return the system whose hub moves the masses and stretches the stiffnesses of exciters, `attached` being (6,).

    A + F C D F' in place of A: its response to e is that of `true_load_matrices`, and its modes are those of a run.
    """
    equations = system.equations
    if not _may_resist_motion(equations):
        return system
    resistance = (equations.exciter_mass, equations.exciter_stiffness)
    driven = system.inputs @ equations.exciter_cross_axis
    mass, stiffness = ((driven * (attached.astype(float)[None] @ part)) @ equations.inputs.T for part in resistance)
    pencil = replace(system.pencil, mass=system.pencil.mass + mass, stiffness=system.pencil.stiffness + stiffness)
    return replace(system, pencil=pencil)


def _may_resist_motion(equations: Equations) -> bool:
    """Whether exciters resist the motion, or a parameter would make them."""
    resistance = (equations.exciter_mass, equations.exciter_stiffness)
    return any(bool(np.any(part.value) or np.any(part.derivative)) for part in resistance)


def true_load_matrices(
    system: System, solution: Solution, index: Index, attached: Mask, is_static: bool = False
) -> ComplexArray | Array:
    """Matrices (K, 6, 6) from recorded to true loads at lines `index` (K,), or (6, 6) where all are the same.

    `attached` (K, 6): the components whose exciters are attached to the hub.
    """
    cross_axis = system.equations.cross_axis(is_static).value
    if is_static or has_plain_exciters(system.equations):
        return np.asarray(cross_axis)
    return np.asarray(cross_axis @ _load_beyond_cell(system, solution, index, attached))


def _load_beyond_cell(system: System, solution: Solution, index: Index, attached: Mask) -> ComplexArray:
    """Matrices (K, 6, 6) from recorded loads to those on the hub, before the cross-axis matrix."""
    e = _cell_factor(system.equations, solution.frequency[index])
    if not exciters_resist_motion(system.equations):
        return np.asarray(e[:, None, :] * np.eye(6))
    return np.asarray(_inverse_reaction(system, solution, index, attached) * e[:, None, :])


def _cell_factor(equations: Equations, frequency: Array) -> ComplexArray:
    """Load of a force cell over what it records (K, 6)."""
    s = 2j * np.pi * frequency[:, None]
    factor = np.exp(s * equations.load_delay.value) / equations.load_gain.value
    return np.asarray(factor / lag_denominator(equations, frequency))


def loads_without_reaction(
    equations: Equations, frequency: Array, loads: ComplexArray, is_static: bool = False
) -> ComplexArray:
    """Return C e (K, 6) for recorded `loads` (K, 6) at frequencies (K,) [Hz]: the true loads where D is zero."""
    beyond = loads if is_static else _cell_factor(equations, frequency) * loads
    return np.asarray(beyond @ equations.cross_axis(is_static).value.T)


def loads_without_reaction_derivatives(
    equations: Equations, frequency: Array, loads: ComplexArray, is_static: bool = False
) -> tuple[Mask, ComplexArray]:
    """Return the parameters (p,) that change `loads_without_reaction`, and its derivatives (K, 6, q) by them."""
    cross_axis = equations.cross_axis(is_static)
    own = np.asarray(cross_axis.derivative.any(axis=(1, 2)))
    if is_static:
        return own, multiply_derivatives(cross_axis.derivative[own], loads)
    for part in (equations.load_gain, equations.load_delay, equations.load_lag):
        own = np.asarray(own | part.derivative.any(axis=tuple(range(1, part.derivative.ndim))))
    of_matrix = multiply_derivatives(cross_axis.derivative[own], _cell_factor(equations, frequency) * loads)
    return own, np.asarray(of_matrix + cross_axis.value @ _cell_derivatives(equations, frequency, loads, own))


def _cell_derivatives(equations: Equations, frequency: Array, loads: ComplexArray, own: Mask) -> ComplexArray:
    """Derivatives (K, 6, q) of the loads beyond the force cells by the parameters `own` (p,), at constant motion."""
    gain, delay, lag = equations.load_gain, equations.load_delay, equations.load_lag
    s = 2j * np.pi * frequency[:, None, None]
    beyond = (_cell_factor(equations, frequency) * loads)[:, :, None]
    change = beyond * (s * delay.derivative[own].T - (gain.derivative[own] / gain.value).T)
    if np.any(lag.derivative[own]):
        first, second = np.moveaxis(lag.derivative[own], 2, 0)
        change = change - beyond * (s * first.T + s**2 * second.T) / lag_denominator(equations, frequency)[:, :, None]
    return np.asarray(change)


def lag_denominator(equations: Equations, frequency: Array) -> ComplexArray:
    """Return what is recorded over the load that follows it, 1 + s a + s^2 b (K, 6), at frequencies (K,) [Hz]."""
    s = 2j * np.pi * frequency[:, None]
    first, second = equations.load_lag.value.T
    return np.asarray(1.0 + s * first + s**2 * second)


def recorded_over_load(equations: Equations, frequency: Array) -> ComplexArray:
    """Return what the lag and the delay of the exciters make of a load that is recorded (K, 6), at K frequencies [Hz].

    It is exp(-s delay) (1 + s a + s^2 b), the size of which the gain of a force cell would change alone.
    """
    s = 2j * np.pi * frequency[:, None]
    return np.asarray(np.exp(-s * equations.load_delay.value) * lag_denominator(equations, frequency))


def _inverse_reaction(system: System, solution: Solution, index: Index, attached: Mask) -> ComplexArray:
    """(1 + D H)^-1 (K, 6, 6)."""
    resistance = _dynamic_stiffness(system.equations, solution.frequency[index], attached)
    motion = (hub_motion(system, solution) @ system.equations.exciter_cross_axis.value)[index]
    return np.asarray(np.linalg.inv(np.eye(6) + resistance[:, :, None] * motion))


def _dynamic_stiffness(equations: Equations, frequency: Array, attached: Mask) -> Array:
    """Diagonals (K, 6) of D: s^2 mass + stiffness of the exciters that are attached."""
    square = -((2 * np.pi * frequency[:, None]) ** 2)
    mass, stiffness = equations.exciter_mass.value, equations.exciter_stiffness.value
    return np.asarray(square * (attached @ mass) + attached @ stiffness)


def true_loads(
    system: System, solution: Solution, index: Index, loads: ComplexArray, attached: Mask, is_static: bool = False
) -> ComplexArray:
    """True loads (K, 6) for recorded `loads` (K, 6) at lines `index` (K,)."""
    matrices = true_load_matrices(system, solution, index, attached, is_static)
    return np.asarray(np.matmul(matrices, loads[:, :, None])[:, :, 0])


def true_load_derivatives(
    system: System, solution: Solution, index: Index, loads: ComplexArray, attached: Mask, is_static: bool = False
) -> tuple[Mask, ComplexArray] | None:
    """Parameters (p,) that change the true loads for recorded `loads` (K, 6), and the derivatives (K, 6, q) by them.

    None where no parameter changes them.
    """
    equations = system.equations
    own = _load_parameters(equations, is_static)
    if not own.any():
        return None
    cross_axis = equations.cross_axis(is_static)
    beyond = loads
    change = None if is_static else _beyond_cell_derivatives(system, solution, index, loads, attached, own)
    if not is_static and not has_plain_exciters(equations):
        beyond = np.matmul(_load_beyond_cell(system, solution, index, attached), loads[:, :, None])[:, :, 0]
    of_matrix = multiply_derivatives(cross_axis.derivative[own], beyond)
    return own, of_matrix if change is None else np.asarray(cross_axis.value @ change + of_matrix, complex)


def _load_parameters(equations: Equations, is_static: bool) -> Mask:
    """Which parameters (p,) change the true loads: all of them where exciters resist the motion."""
    cross_axis = equations.cross_axis(is_static).derivative
    own = np.asarray(cross_axis.any(axis=(1, 2)))
    if is_static:
        return own
    if exciters_resist_motion(equations):
        return np.ones_like(own)
    for part in (equations.load_gain, equations.load_delay):
        own = np.asarray(own | part.derivative.any(axis=1))
    for part in (equations.load_lag, equations.exciter_mass, equations.exciter_stiffness):
        own = np.asarray(own | part.derivative.any(axis=(1, 2)))
    return own


def _beyond_cell_derivatives(
    system: System, solution: Solution, index: Index, loads: ComplexArray, attached: Mask, own: Mask
) -> ComplexArray | None:
    """Derivatives (K, 6, q) of the loads on the hub before the cross-axis matrix, by the parameters `own` (p,)."""
    equations = system.equations
    gain, delay, lag = equations.load_gain, equations.load_delay, equations.load_lag
    resistance = (equations.exciter_mass, equations.exciter_stiffness)
    if has_plain_exciters(equations) and not any(np.any(part.derivative) for part in (gain, delay, lag, *resistance)):
        return None
    recorded = _cell_factor(equations, solution.frequency[index]) * loads
    change = _cell_derivatives(equations, solution.frequency[index], loads, own)
    if not _may_resist_motion(equations):
        return np.asarray(change)
    inverse = _inverse_reaction(system, solution, index, attached)
    beyond = np.matmul(inverse, recorded[:, :, None])[:, :, 0]
    return np.asarray(
        np.matmul(inverse, change - _reaction_derivatives(system, solution, index, beyond, attached, own))
    )


def _reaction_derivatives(
    system: System, solution: Solution, index: Index, beyond: ComplexArray, attached: Mask, own: Mask
) -> ComplexArray:
    """Derivatives (K, 6, q) by the parameters `own` (p,) of D H v, at constant v: the loads `beyond` (K, 6)."""
    equations, frequency = system.equations, solution.frequency[index]
    square = -((2 * np.pi * frequency[:, None, None]) ** 2)
    mass, stiffness = equations.exciter_mass.derivative[own], equations.exciter_stiffness.derivative[own]
    acting = beyond @ equations.exciter_cross_axis.value.T
    motion = np.matmul(hub_motion(system, solution)[index], acting[:, :, None])
    of_resistance = square * np.einsum("ki,qij->kjq", attached, mass) + np.einsum("ki,qij->kjq", attached, stiffness)
    if not exciters_resist_motion(equations):
        return np.asarray(of_resistance * motion)
    of_motion = hub_motion_jacobian(system, solution, index, acting)[:, :, own]
    turned = multiply_derivatives(equations.exciter_cross_axis.derivative[own], beyond)
    of_motion = of_motion + np.matmul(hub_motion(system, solution)[index], turned)
    resistance = _dynamic_stiffness(equations, frequency, attached)
    return np.asarray(of_resistance * motion + resistance[:, :, None] * of_motion)
