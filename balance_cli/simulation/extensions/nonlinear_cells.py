"""Nonlinear forces along the cells: springs, stops, slipping contacts and dampers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.simulation.extensions.base import Extension
from balance_cli.simulation.mechanics import Mechanics, NonlinearCellForce

INSIDE, BESIDE = "inside", "beside"


def read_by_channels(side: str) -> bool:
    """Whether the cell's channels read a force on this `side`. Raises UserError for an unknown side."""
    if side not in (INSIDE, BESIDE):
        raise UserError(f"`side` is `{side}`, not `{INSIDE}` or `{BESIDE}`", place="effects")
    return side == INSIDE


def _with_forces(
    extension: Extension, mechanics: Mechanics, geometry: Geometry, force: NonlinearCellForce
) -> Mechanics:
    cells = extension.places(geometry.cell_names)
    return replace(mechanics, forces=mechanics.forces + tuple(replace(force, cell=cell) for cell in cells))


@dataclass(frozen=True)
class CubicStiffness(Extension):
    """A force `k3 d^3` [N/m3] along the cell; `inside` it, its channels read it, `beside` it they do not."""

    name: ClassVar[str] = "cubic-stiffness"
    k3: float = 0.0
    side: str = INSIDE

    def mechanics(self, mechanics: Mechanics, geometry: Geometry, rotor_speed: float) -> Mechanics:
        """The equations with the force at every place."""
        return _with_forces(
            self, mechanics, geometry, NonlinearCellForce(0, k3=self.k3, read_by_channels=read_by_channels(self.side))
        )


@dataclass(frozen=True)
class QuadraticStiffness(Extension):
    """A force `k2 d^2` [N/m2] along the cell; `inside` it, its channels read it, `beside` it they do not."""

    name: ClassVar[str] = "quadratic-stiffness"
    k2: float = 0.0
    side: str = INSIDE

    def mechanics(self, mechanics: Mechanics, geometry: Geometry, rotor_speed: float) -> Mechanics:
        """The equations with the force at every place."""
        return _with_forces(
            self, mechanics, geometry, NonlinearCellForce(0, k2=self.k2, read_by_channels=read_by_channels(self.side))
        )


@dataclass(frozen=True)
class FreePlay(Extension):
    """Stops beside the cell, each a spring `stiffness` [N/m], that touch where the elongation exceeds `gap` [m]."""

    name: ClassVar[str] = "free-play"
    stiffness: float = 0.0
    gap: float = 0.0

    def mechanics(self, mechanics: Mechanics, geometry: Geometry, rotor_speed: float) -> Mechanics:
        """The equations with the stops at every place. Raises UserError for a negative gap or stiffness."""
        if self.stiffness < 0.0 or self.gap < 0.0:
            fault = f"`{self.name}` needs `stiffness` and `gap` of at least 0"
            raise UserError(fault, place="effects", remedy="Give both, in N/m and m")
        stops = NonlinearCellForce(0, stop_stiffness=self.stiffness, gap=self.gap)
        return _with_forces(self, mechanics, geometry, stops)


@dataclass(frozen=True)
class DryFriction(Extension):
    """A slipping contact beside the cell: a spring `stick_stiffness` [N/m] that slips at `force` [N] (Jenkins)."""

    name: ClassVar[str] = "dry-friction"
    force: float = 0.0
    stick_stiffness: float = 0.0

    def mechanics(self, mechanics: Mechanics, geometry: Geometry, rotor_speed: float) -> Mechanics:
        """The equations with the contact at every place. Raises UserError where the contact has no spring."""
        if self.stick_stiffness <= 0.0 or self.force < 0.0:
            fault = f"`{self.name}` needs `force` of at least 0 and `stick_stiffness` above 0"
            raise UserError(fault, place="effects", remedy="Give both, in N and N/m")
        contact = NonlinearCellForce(0, stick_stiffness=self.stick_stiffness, limit=self.force)
        return _with_forces(self, mechanics, geometry, contact)


@dataclass(frozen=True)
class AsymmetricFriction(Extension):
    """A slipping contact beside the cell with the limits `force` times 1 + `asymmetry` and 1 - `asymmetry` [N]."""

    name: ClassVar[str] = "asymmetric-friction"
    force: float = 0.0
    asymmetry: float = 0.0
    stick_stiffness: float = 0.0

    def mechanics(self, mechanics: Mechanics, geometry: Geometry, rotor_speed: float) -> Mechanics:
        """The equations with the contact at every place. Raises UserError where it has no spring or a limit below 0."""
        if self.stick_stiffness <= 0.0 or self.force < 0.0 or abs(self.asymmetry) > 1.0:
            fault = f"`{self.name}` needs `force` of at least 0, `asymmetry` of -1 to 1 and `stick_stiffness` above 0"
            raise UserError(fault, place="effects", remedy="Give them in N, 1 and N/m")
        contact = NonlinearCellForce(0, stick_stiffness=self.stick_stiffness, limit=self.force)
        contact = replace(contact, asymmetry=self.asymmetry)
        return _with_forces(self, mechanics, geometry, contact)


@dataclass(frozen=True)
class StribeckFriction(Extension):
    """A slipping contact beside the cell: `static_force` [N] at rest falls to `force` [N] by `speed` [m/s]."""

    name: ClassVar[str] = "stribeck-friction"
    force: float = 0.0
    static_force: float = 0.0
    speed: float = 0.0
    stick_stiffness: float = 0.0

    def mechanics(self, mechanics: Mechanics, geometry: Geometry, rotor_speed: float) -> Mechanics:
        """The equations with the contact at every place. Raises UserError where a value is missing."""
        if min(self.stick_stiffness, self.static_force, self.speed) <= 0.0 or self.force < 0.0:
            fault = f"`{self.name}` needs `static_force`, `speed` and `stick_stiffness` above 0, `force` of at least 0"
            raise UserError(fault, place="effects", remedy="Give them in N, m/s and N/m")
        contact = NonlinearCellForce(0, stick_stiffness=self.stick_stiffness, limit=self.static_force)
        contact = replace(contact, fast_share=self.force / self.static_force, speed=self.speed)
        return _with_forces(self, mechanics, geometry, contact)


@dataclass(frozen=True)
class QuadraticDamping(Extension):
    """A force `c2` [N s2/m2] times rate times size of the rate beside the cell, whose channels do not read it."""

    name: ClassVar[str] = "quadratic-damping"
    c2: float = 0.0

    def mechanics(self, mechanics: Mechanics, geometry: Geometry, rotor_speed: float) -> Mechanics:
        """The equations with the damper at every place."""
        return _with_forces(self, mechanics, geometry, NonlinearCellForce(0, c2=self.c2))


@dataclass(frozen=True)
class AsymmetricDamping(Extension):
    """A dashpot beside the cell, `difference` [N s/m] larger in elongation than in compression, with a mean of zero."""

    name: ClassVar[str] = "asymmetric-damping"
    difference: float = 0.0

    def mechanics(self, mechanics: Mechanics, geometry: Geometry, rotor_speed: float) -> Mechanics:
        """The equations with the force at every place."""
        return _with_forces(self, mechanics, geometry, NonlinearCellForce(0, damping_difference=self.difference))
