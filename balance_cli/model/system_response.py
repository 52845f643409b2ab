"""The frequency response of a system: forces of the springs and volts of the channels for given loads."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.model.channel_gains import channel_gains
from balance_cli.model.pole_response import forces_from_poles, solved_forces
from balance_cli.model.system import System, complex_readings, dynamic_stiffness

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class Solution:
    """A system solved at k frequencies, before any load is applied.

    `receptance` (k, n, n) is A^-1; `force_influence` (k, e, n), the readings times A^-1; `forces` (k, e, 6) of the
    springs per unit hub load; `gains` (k, c), volts per unit of a spring's force. `frequency` (k,) and `spin` [Hz].
    """

    frequency: Array
    spin: float
    force_influence: ComplexArray
    receptance: ComplexArray
    forces: ComplexArray
    gains: ComplexArray


@dataclass(frozen=True)
class SpringInputs:
    """Forces along the springs at K lines besides those of the linear balance.

    `acting` (K, e) act on the balance; `read` (K, e) are also read by the channels of each spring.
    """

    acting: ComplexArray
    read: ComplexArray

    def select(self, lines: Index) -> SpringInputs:
        """The forces at some of the lines."""
        return SpringInputs(self.acting[lines], self.read[lines])


def solve(system: System, frequency: Array, spin: float = 0.0) -> Solution:
    """Invert the dynamic stiffness once; responses and derivatives follow from it."""
    frequency = np.atleast_1d(np.asarray(frequency, float))
    receptance = np.asarray(np.linalg.inv(dynamic_stiffness(system.pencil, frequency, spin)), complex)
    force_influence = np.asarray(complex_readings(system, frequency) @ receptance, complex)
    forces = np.asarray(force_influence @ system.inputs.value, complex)
    gains = channel_gains(system.equations.paths, frequency)
    return Solution(frequency, spin, force_influence, receptance, forces, gains)


def response(system: System, solution: Solution) -> ComplexArray:
    """T (k, c, 6), volts per unit of the true hub loads, without the cross-axis matrix of an exciter."""
    volts = solution.gains[:, :, None] * solution.forces[:, system.springs_of_channels]
    return _mix_channels(system, volts)


def load_response(system: System, frequency: Array, spin: float = 0.0) -> ComplexArray:
    """T (k, c, 6) at `frequency` (k,) [Hz], as `response` has it of a solution, in half the time.

    It needs no inverse, from which derivatives follow; many frequencies need no solution each.
    """
    forces = forces_from_poles(system, frequency, spin)
    if forces is None:
        forces = solved_forces(system, frequency, spin)
    gains = channel_gains(system.equations.paths, frequency)
    volts = gains[:, :, None] * forces[:, system.springs_of_channels]
    return _mix_channels(system, volts)


def hub_motion(system: System, solution: Solution) -> ComplexArray:
    """Motion (k, 6, 6) of the hub, x y z [m] and rotations about them, per unit of the true hub loads.

    By the principle of virtual work it is that in which each load works.
    """
    return np.asarray(system.equations.inputs.value.T @ solution.receptance @ system.inputs.value)


def spring_forces(
    system: System, solution: Solution, index: Index, loads: ComplexArray, extra: SpringInputs | None
) -> ComplexArray:
    """Forces (K, e) of the springs for loads (K, 6) and extra forces along them, at lines `index` (K,)."""
    forces = np.asarray(np.matmul(solution.forces[index], loads[:, :, None])[:, :, 0])
    return forces if extra is None else forces + extra_forces(system, solution, index, extra)


def extra_forces(system: System, solution: Solution, index: Index, extra: SpringInputs) -> ComplexArray:
    """The part (K, e) of the springs' forces, as read, that is due to the extra ones."""
    through = (solution.force_influence @ system.reactions.value)[index]
    read = extra.read @ system.equations.summation.T
    return np.asarray(np.matmul(through, extra.acting[:, :, None])[:, :, 0] + read)


def volts_of_forces(system: System, solution: Solution) -> tuple[ComplexArray, ComplexArray]:
    """Volts (k, c, e) per unit of a force that acts along each spring, and of one that its channels read."""
    springs = system.springs_of_channels
    gains = solution.gains[:, :, None]
    acting = gains * (solution.force_influence @ system.reactions.value)[:, springs]
    read = gains * system.equations.summation[springs]
    return _mix_channels(system, acting), _mix_channels(system, read)


def readings_of_inputs(system: System, solution: Solution, force: ComplexArray) -> ComplexArray:
    """Volts (k, s, c) of s generalized forces (k, s, n) at each frequency, virtual work per unit of each coordinate."""
    excitation = force * system.equations.row_factor.value
    springs = (excitation @ solution.force_influence.swapaxes(1, 2))[:, :, system.springs_of_channels]
    volts = (solution.gains[:, None, :] * springs).swapaxes(1, 2)
    return np.asarray(_mix_channels(system, volts).swapaxes(1, 2))


def _mix_channels(system: System, volts: ComplexArray) -> ComplexArray:
    """Volts (k, c, ...) with the crosstalk of the channels; the same ones where there is none."""
    mixing = system.equations.mixing.value
    return volts if np.array_equal(mixing, np.eye(len(mixing))) else np.asarray(mixing @ volts)
