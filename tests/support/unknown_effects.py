"""Effects that a rig may have and no effect of the library describes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.simulation.extensions.base import Extension, Signals
from balance_cli.simulation.mechanics import Mechanics

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TunedMass(Extension):
    """A `mass` [kg] of the metric side that swings along `direction` on a spring at `position` [m] of the plate.

    `frequency` [Hz] and `damping_ratio` are those of the mass on its spring alone (Den Hartog, Mechanical Vibrations,
    1956, chapter 3). At rest it hangs along: the static response stays as it is.
    """

    name: ClassVar[str] = "tuned-mass"
    mass: float = 0.5
    frequency: float = 50.0
    damping_ratio: float = 0.01
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    direction: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def mechanics(self, mechanics: Mechanics, geometry: Geometry, rotor_speed: float) -> Mechanics:
        """With the motion of the mass along the direction, against the plate, as a further coordinate."""
        wide = mechanics.with_coordinates(("tuned mass",))
        carried = wide.plate_displacement(self.position)
        # Displacement of the mass: that of its point, and its own along the direction.
        rows = carried.copy()
        rows[:, -1] += np.array(self.direction)
        omega = 2 * np.pi * self.frequency
        own = np.zeros(wide.size)
        own[-1] = 1.0
        spring, dashpot = self.mass * omega**2, 2 * self.damping_ratio * self.mass * omega
        return replace(
            wide,
            mass=wide.mass + self.mass * (rows.T @ rows - carried.T @ carried),
            damping=wide.damping + dashpot * np.outer(own, own),
        ).with_springs(own[None, :], np.array([spring]))


@dataclass(frozen=True)
class SaturatingChannel(Extension):
    """A channel whose amplifier bends at large amplitude, `v -> limit tanh(v / limit)`, in motion and at rest."""

    name: ClassVar[str] = "saturating-channel"
    limit: float = 10.0

    def volts(self, signals: Signals) -> Array:
        """Bent."""
        volts = signals.volts.copy()
        for index in self.places(signals.names):
            volts[:, index] = self.limit * np.tanh(volts[:, index] / self.limit)
        return volts


@dataclass(frozen=True)
class RectifyingChannel(Extension):
    """A channel whose amplifier reads too much where it is positive, by `v^2 / limit`, in motion and at rest."""

    name: ClassVar[str] = "rectifying-channel"
    limit: float = 100.0

    def volts(self, signals: Signals) -> Array:
        """More where they are positive."""
        volts = signals.volts.copy()
        for index in self.places(signals.names):
            volts[:, index] += np.maximum(volts[:, index], 0.0) ** 2 / self.limit
        return volts
