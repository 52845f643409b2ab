"""Effects in the cells: springs that are not linear, that slip, relax, stand askew or resist sideways."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from balance_cli.errors import UserError
from balance_cli.simulation.extensions.base import Extension
from balance_cli.simulation.mechanics import CellForce, Mechanics
from balance_cli.simulation.rig import TrueRig

INSIDE, BESIDE = "inside", "beside"


def felt(side: str) -> bool:
    """Whether the cell's channels read a force on this `side`. UserError for a side that is none."""
    if side not in (INSIDE, BESIDE):
        raise UserError(f"`side` is `{side}`, not `{INSIDE}` or `{BESIDE}`", place="effects")
    return side == INSIDE


def _with_forces(extension: Extension, mechanics: Mechanics, rig: TrueRig, force: CellForce) -> Mechanics:
    cells = extension.places(rig.geometry.cell_names)
    return replace(mechanics, forces=mechanics.forces + tuple(replace(force, cell=cell) for cell in cells))


@dataclass(frozen=True)
class CubicStiffness(Extension):
    """A force `k3 d^3` [N/m3] along the cell; `inside` it, its channels read it, `beside` it they do not."""

    name: ClassVar[str] = "cubic-stiffness"
    k3: float = 0.0
    side: str = INSIDE

    def mechanics(self, mechanics: Mechanics, rig: TrueRig, rotor_speed: float) -> Mechanics:
        """With the force at every place."""
        return _with_forces(self, mechanics, rig, CellForce(0, k3=self.k3, felt=felt(self.side)))


@dataclass(frozen=True)
class QuadraticStiffness(Extension):
    """A force `k2 d^2` [N/m2] along the cell; `inside` it, its channels read it, `beside` it they do not."""

    name: ClassVar[str] = "quadratic-stiffness"
    k2: float = 0.0
    side: str = INSIDE

    def mechanics(self, mechanics: Mechanics, rig: TrueRig, rotor_speed: float) -> Mechanics:
        """With the force at every place."""
        return _with_forces(self, mechanics, rig, CellForce(0, k2=self.k2, felt=felt(self.side)))


@dataclass(frozen=True)
class DryFriction(Extension):
    """A slipping contact beside the cell: a spring `stick_stiffness` [N/m] that slips at `force` [N] (Jenkins)."""

    name: ClassVar[str] = "dry-friction"
    force: float = 0.0
    stick_stiffness: float = 0.0

    def mechanics(self, mechanics: Mechanics, rig: TrueRig, rotor_speed: float) -> Mechanics:
        """With the contact at every place."""
        contact = CellForce(0, stick_stiffness=self.stick_stiffness, limit=self.force)
        return _with_forces(self, mechanics, rig, contact)
