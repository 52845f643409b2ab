"""Cell forces and torque of sampled runs; nonlinear forces are integrated for all runs at once."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.simulation.integrate import ModalSystem
from balance_cli.simulation.mechanics import Mechanics
from balance_cli.simulation.nonlinear import NonlinearForces, RestState, integrate_nonlinear_forces, solve_rest_state
from balance_cli.simulation.response import forces_read_by_channels, full_system

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RigDynamics:
    """A rig at one rotor speed: its equations of motion, and their linear system (c cells, m nonlinear forces)."""

    mechanics: Mechanics
    system: ModalSystem

    @classmethod
    def from_mechanics(cls, mechanics: Mechanics) -> RigDynamics:
        """The dynamics of these equations of motion."""
        return cls(mechanics, full_system(mechanics))

    @property
    def sensors(self) -> int:
        """Number of outputs before the motions: cells, torque meters and accelerometers."""
        return self.mechanics.sensors

    def motions(self, loads: Array, step: float) -> Array:
        """Elongations and rates (n, m or 2m) where nonlinear forces act, under the hub loads (n, 6) alone."""
        return self.system.subsystem(slice(self.sensors, None), slice(0, 6)).response(loads, step)

    @property
    def sensor_system(self) -> ModalSystem:
        """Cell forces as the channels read them, torques and accelerations (c+t+a), of hub loads and forces (6+m)."""
        system = self.system.subsystem(slice(0, self.sensors), slice(None))
        direct = system.direct.copy()
        direct[:, 6:] += forces_read_by_channels(self.mechanics, np.eye(len(self.mechanics.forces))).T
        return replace(system, direct=direct)

    def forces(self, inputs: Array, step: float) -> Array:
        """Cell forces, torques and accelerations (n, c+t+a) under hub loads and nonlinear forces (n, 6+m)."""
        return self.sensor_system.response(inputs, step)


def nonlinear_forces(motion: RigDynamics, runs: Iterable[Array], step: float) -> list[Array]:
    """Nonlinear forces (n, m) of several runs, from their hub loads (n, 6), integrated for all runs at once."""
    forces = NonlinearForces.from_cell_forces(motion.mechanics.forces)
    gain = motion.system.static_gain()[motion.sensors :][: len(motion.mechanics.forces)]
    starts, linear = [], []
    for loads in runs:
        starts.append(solve_rest_state(forces, gain, loads[:1]))
        linear.append(motion.motions(loads, step))
    longest = max(map(len, linear))
    padded = np.stack([np.pad(run, ((0, longest - len(run)), (0, 0)), "edge") for run in linear], axis=1)
    start = RestState(
        *(np.vstack(rows) for rows in zip(*((s.elongation, s.force, s.contact) for s in starts), strict=True))
    )
    driven = motion.system.subsystem(slice(motion.sensors, None), slice(6, None))
    result = integrate_nonlinear_forces(forces, driven, start, padded, step)
    return [result[: len(run), i] for i, run in enumerate(linear)]
