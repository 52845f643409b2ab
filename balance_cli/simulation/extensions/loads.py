"""Effects in the exciters: loads that their force cells do not measure, and errors of their readings."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.simulation import filters
from balance_cli.simulation.extensions.base import ALL, Extension
from balance_cli.simulation.mechanics import Mechanics

Array = NDArray[np.float64]

KINDS_WITH_EXCITERS = ("sweep", "check")
"""Kinds of run in which exciters apply the loads."""


@dataclass(frozen=True)
class ExciterMisalignment(Extension):
    """The exciter of the first component also applies a `fraction` of its load in the second, which is not measured."""

    name: ClassVar[str] = "exciter-misalignment"
    fraction: float = 0.0

    def true_loads(self, loads: Array, kind: str) -> Array:
        """The loads with the unmeasured part."""
        return _add_cross_axis(self, loads, self.fraction) if kind in KINDS_WITH_EXCITERS else loads


@dataclass(frozen=True)
class WeightMisalignment(Extension):
    """In static runs a `fraction` of the first component's load also acts in the second, where none is recorded."""

    name: ClassVar[str] = "weight-misalignment"
    fraction: float = 0.0

    def true_loads(self, loads: Array, kind: str) -> Array:
        """The loads with the part that is not recorded."""
        return _add_cross_axis(self, loads, self.fraction) if kind == "static" else loads


def _add_cross_axis(extension: Extension, loads: Array, fraction: float) -> Array:
    """Loads (n, 6) with a fraction of the first component of the place in the second."""
    applied, cross = extension.pair(COMPONENTS)
    loads = loads.copy()
    loads[:, cross] += fraction * loads[:, applied]
    return loads


@dataclass(frozen=True)
class LoadOffset(Extension):
    """The exciter's force cell has an `offset` [N, N m]."""

    name: ClassVar[str] = "load-offset"
    offset: float = 0.0

    def recorded_loads(self, loads: Array, kind: str, step: float | None = None) -> Array:
        """The readings with the offset."""
        shifted = loads.copy()
        shifted[:, self.places(COMPONENTS)] += self.offset
        return shifted


@dataclass(frozen=True)
class LoadGain(Extension):
    """The exciter's force cell reads `gain` times its load."""

    name: ClassVar[str] = "load-gain"
    gain: float = 1.0

    def recorded_loads(self, loads: Array, kind: str, step: float | None = None) -> Array:
        """The scaled readings; weights have none."""
        return self._scaled(loads, self.gain) if kind in KINDS_WITH_EXCITERS else loads

    def loads_from_recorded(self, recorded: Array, kind: str, step: float) -> Array:
        """The loads of which these are the readings."""
        return self._scaled(recorded, 1.0 / self.gain) if kind in KINDS_WITH_EXCITERS else recorded

    def _scaled(self, loads: Array, factor: float) -> Array:
        scaled = loads.copy()
        scaled[:, self.places(COMPONENTS)] *= factor
        return scaled


@dataclass(frozen=True)
class LoadDelay(Extension):
    """The reading of the exciter's force cell is late by `delay` [s] (early where negative)."""

    name: ClassVar[str] = "load-delay"
    delay: float = 0.0

    def recorded_loads(self, loads: Array, kind: str, step: float | None = None) -> Array:
        """The readings shifted in time."""
        return self._shifted(loads, self.delay, kind, step)

    def loads_from_recorded(self, recorded: Array, kind: str, step: float) -> Array:
        """The loads of which these are the readings."""
        return self._shifted(recorded, -self.delay, kind, step)

    def _shifted(self, loads: Array, delay: float, kind: str, step: float | None) -> Array:
        if step is None or kind not in KINDS_WITH_EXCITERS:
            return loads
        shifted = loads.copy()
        for index in self.places(COMPONENTS):
            shifted[:, index] = filters.delay_signal(loads[:, index], delay, step)
        return shifted


@dataclass(frozen=True)
class ExciterLowPass(Extension):
    """The load of the exciter follows what is recorded like a low-pass, of second order where it has a natural period.

    `cutoff` [Hz] is that of the first order, `natural_period` [s] that of free oscillations.
    """

    name: ClassVar[str] = "exciter-low-pass"
    cutoff: float = np.inf
    natural_period: float = 0.0

    @property
    def _terms(self) -> tuple[float, float]:
        """The factors of the load's first and second derivative [s, s2] in what is recorded."""
        return 0.5 / (np.pi * self.cutoff), (0.5 * self.natural_period / np.pi) ** 2

    def recorded_loads(self, loads: Array, kind: str, step: float | None = None) -> Array:
        """The readings: the loads, and their derivatives in time."""
        if step is None or kind not in KINDS_WITH_EXCITERS:
            return loads
        first, second = self._terms
        recorded = loads.copy()
        for index in self.places(COMPONENTS):
            rate = filters.derivative(loads[:, index], step)
            recorded[:, index] += first * rate + second * filters.derivative(rate, step)
        return recorded

    def loads_from_recorded(self, recorded: Array, kind: str, step: float) -> Array:
        """The loads of which these are the readings."""
        if kind not in KINDS_WITH_EXCITERS:
            return recorded
        first, second = self._terms
        loads = recorded.copy()
        for index in self.places(COMPONENTS):
            loads[:, index] = filters.followed(recorded[:, index], (first, second), step)
        return loads


@dataclass(frozen=True)
class ExciterMass(Extension):
    """A `mass` [kg], along a moment a moment of inertia [kg m2], moves with the hub while its exciter is attached.

    The first name of the place is the component of the exciter, the last one that along which the mass moves.
    """

    name: ClassVar[str] = "exciter-mass"
    mass: float = 0.0

    def exciter_mechanics(self, mechanics: Mechanics, attached: Collection[str]) -> Mechanics:
        """The equations with the inertia along the loads of the attached exciters."""
        self.places(COMPONENTS)
        columns = [i for i, name in enumerate(COMPONENTS) if name == self.where[-1] and self.where[0] in attached]
        rows = mechanics.loads[:, columns]
        return replace(mechanics, mass=mechanics.mass + self.mass * rows @ rows.T)


@dataclass(frozen=True)
class ExciterStiffness(Extension):
    """A `stiffness` [N/m], along a moment [N m/rad], holds the hub while its exciter is attached.

    The first name of the place is the component of the exciter, the last one that along which it holds the hub.
    """

    name: ClassVar[str] = "exciter-stiffness"
    stiffness: float = 0.0

    def exciter_mechanics(self, mechanics: Mechanics, attached: Collection[str]) -> Mechanics:
        """The equations with the springs along the loads of the attached exciters."""
        self.places(COMPONENTS)
        columns = [i for i, name in enumerate(COMPONENTS) if name == self.where[-1] and self.where[0] in attached]
        rows = mechanics.loads[:, columns]
        return replace(mechanics, stiffness=mechanics.stiffness + self.stiffness * rows @ rows.T)


@dataclass(frozen=True)
class ExciterPosition(Extension):
    """The exciters of the forces named act at the point `x`, `y`, `z` [m] from the hub, and not at the hub."""

    name: ClassVar[str] = "exciter-position"
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0

    def true_loads(self, loads: Array, kind: str) -> Array:
        """The loads at the hub, with the moments of the forces about it."""
        if kind not in KINDS_WITH_EXCITERS:
            return loads
        acting = np.array([self.where == (ALL,) or name in self.where for name in COMPONENTS[:3]])
        self.places(COMPONENTS)
        shifted = loads.copy()
        shifted[:, 3:] += np.cross((self.x, self.y, self.z), loads[:, :3] * acting)
        return shifted
