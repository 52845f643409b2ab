"""Effects in the structure, which the rigid plate on rigid ground neglects."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS, FREEDOMS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.simulation.extensions.base import Extension
from balance_cli.simulation.mechanics import Mechanics, displacement_rows

Array = NDArray[np.float64]


def _attach_to_ground(mechanics: Mechanics, start: int, masses: Array, compliances: Array, ratio: float) -> Mechanics:
    """The equations with masses and springs on the coordinates from `start` on; `d = 2 zeta sqrt(k m)` for each."""
    springs = 1 / compliances
    for matrix, diagonal in (
        (mechanics.mass, masses),
        (mechanics.stiffness, springs),
        (mechanics.damping, 2 * ratio * np.sqrt(springs * masses)),
    ):
        matrix[start:, start:] += np.diag(diagonal)
    return mechanics


def _flexible_motions(extension: Extension, known: tuple[str, ...]) -> tuple[str, ...]:
    """The motions of `where` that have a compliance. Raises UserError for an unknown motion."""
    flexible = [known[index] for index in extension.places(known)]
    return tuple(name for name in known if name in flexible and getattr(extension, f"compliance_{name}") > 0)


@dataclass(frozen=True)
class SupportFlexibility(Extension):
    """The non-metric side, to which the cells are fixed, is a rigid body on springs.

    `where`: which of its motions x y z psi theta phi (of its center, at `x`, `y`, `z` [m]) are flexible; for each its
    `compliance` [m/N, rad/(N m)], null 0, and its inertia: `mass` [kg] in x y z, `inertia_*` [kg m2] in rotation.
    `damping_ratio` is that of each of these motions alone, with the plate removed. The plate's damping acts on its
    motion relative to the non-metric side.
    """

    name: ClassVar[str] = "support-flexibility"
    mass: float = 0.0
    inertia_psi: float = 0.0
    inertia_theta: float = 0.0
    inertia_phi: float = 0.0
    compliance_x: float = 0.0
    compliance_y: float = 0.0
    compliance_z: float = 0.0
    compliance_psi: float = 0.0
    compliance_theta: float = 0.0
    compliance_phi: float = 0.0
    damping_ratio: float = 0.0
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0

    def mechanics(self, mechanics: Mechanics, geometry: Geometry, rotor_speed: float) -> Mechanics:
        """The equations with the motions of the non-metric side as further coordinates."""
        motions = _flexible_motions(self, FREEDOMS)
        masses = np.array([self.mass if name in "xyz" else getattr(self, f"inertia_{name}") for name in motions])
        if not np.all(masses > 0):
            raise UserError("the non-metric side needs a mass or inertia for each motion", place="effects")
        start = mechanics.size
        # Motion of the non-metric side at the rig's origin per motion of its center.
        at_origin = np.vstack([displacement_rows((-self.x, -self.y, -self.z)), np.eye(6)[3:]])
        base = at_origin[:, [FREEDOMS.index(name) for name in motions]]
        # Motion of the plate's center of gravity when the plate moves with the non-metric side.
        along = np.vstack([displacement_rows(mechanics.cg), np.eye(6)[3:]]) @ base
        relative = np.hstack([np.eye(start), -mechanics.carried.T @ along])
        wide = mechanics.with_coordinates(tuple(f"base {name}" for name in motions))
        wide = replace(wide, non_metric_motion=np.hstack([np.zeros((6, start)), base]))
        lower = [cell.direction @ wide.non_metric_displacement(cell.position) for cell in geometry.cells]
        wide = replace(
            wide, cell_rows=wide.cell_rows - np.array(lower), damping=relative.T @ mechanics.damping @ relative
        )
        compliances = np.array([getattr(self, f"compliance_{name}") for name in motions])
        return _attach_to_ground(wide, start, masses, compliances, self.damping_ratio)


@dataclass(frozen=True)
class MastBending(Extension):
    """The hub, a point `mass` [kg] of the metric side, deflects laterally on the mast.

    `where`: x, y, or both; `compliance_x`, `compliance_y` [m/N] of the hub relative to the plate, null 0;
    `damping_ratio` of the hub on the mast alone. The hub forces act on the hub; its tilt is neglected.
    """

    name: ClassVar[str] = "mast-bending"
    mass: float = 0.0
    compliance_x: float = 0.0
    compliance_y: float = 0.0
    damping_ratio: float = 0.0

    def mechanics(self, mechanics: Mechanics, geometry: Geometry, rotor_speed: float) -> Mechanics:
        """The equations with the hub's deflections as further coordinates."""
        motions = _flexible_motions(self, ("x", "y"))
        if motions and self.mass <= 0:
            raise UserError("the hub on a flexible mast needs a mass", place="effects")
        start = mechanics.size
        axes = ["xyz".index(name) for name in motions]
        wide = mechanics.with_coordinates(tuple(f"hub {name}" for name in motions))
        carried = wide.plate_displacement(geometry.hub)[axes]
        wide.mass[start:] += self.mass * carried
        wide.mass[:, start:] += self.mass * carried.T
        wide.loads[start:, [COMPONENTS.index(f"F{name}") for name in motions]] += np.eye(len(motions))
        compliances = np.array([getattr(self, f"compliance_{name}") for name in motions])
        return _attach_to_ground(wide, start, np.full(len(motions), self.mass), compliances, self.damping_ratio)


@dataclass(frozen=True)
class AddedMass(Extension):
    """An undeclared point `mass` [kg] on the plate at x, y, z [m].

    `damping_share`: how far the plate's damping follows it, from 0 (it stays) to 1 (the damping ratios stay).
    """

    name: ClassVar[str] = "added-mass"
    mass: float = 0.0
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    damping_share: float = 0.0

    def mechanics(self, mechanics: Mechanics, geometry: Geometry, rotor_speed: float) -> Mechanics:
        """The equations with the mass, and with the damping that follows it."""
        rows = mechanics.plate_displacement((self.x, self.y, self.z))
        mass = mechanics.mass + self.mass * rows.T @ rows
        damping = mechanics.damping.copy()
        if self.damping_share and mechanics.plate_damping is not None:
            plate = (slice(len(geometry.freedom)),) * 2
            change = mechanics.plate_damping(mass[plate]) - mechanics.plate_damping(mechanics.mass[plate])
            damping[plate] += self.damping_share * change
        return replace(mechanics, mass=mass, damping=damping)


@dataclass(frozen=True)
class ParallelStiffness(Extension):
    """A load path from the plate to ground beside the cells (hose, cable): three springs [N/m] at x, y, z [m].

    Each has a dashpot in parallel of `damping_time` [s] times its stiffness.
    """

    name: ClassVar[str] = "parallel-stiffness"
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    stiffness_x: float = 0.0
    stiffness_y: float = 0.0
    stiffness_z: float = 0.0
    damping_time: float = 0.0

    def mechanics(self, mechanics: Mechanics, geometry: Geometry, rotor_speed: float) -> Mechanics:
        """The equations with the three springs and their dashpots."""
        springs = np.array([self.stiffness_x, self.stiffness_y, self.stiffness_z])
        rows = mechanics.plate_displacement((self.x, self.y, self.z))
        dashpots = rows.T @ ((self.damping_time * springs)[:, None] * rows)
        return replace(mechanics.with_springs(rows, springs), damping=mechanics.damping + dashpots)


@dataclass(frozen=True)
class ParallelDashpot(Extension):
    """Three dashpots [N s/m] along the rig's axes between the plate at x, y, z [m] and ground, beside the cells."""

    name: ClassVar[str] = "parallel-dashpot"
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    damping_x: float = 0.0
    damping_y: float = 0.0
    damping_z: float = 0.0

    def mechanics(self, mechanics: Mechanics, geometry: Geometry, rotor_speed: float) -> Mechanics:
        """The equations with the three dashpots."""
        rows = mechanics.plate_displacement((self.x, self.y, self.z))
        rates = np.array([self.damping_x, self.damping_y, self.damping_z])
        return replace(mechanics, damping=mechanics.damping + rows.T @ (rates[:, None] * rows))


@dataclass(frozen=True)
class GyroscopicCoupling(Extension):
    """Parts that spin about z with `polar_inertia` [kg m2] couple the tilts of the plate.

    Its angular momentum H = I Omega (theta, -phi, 1) turns with the plate: about x acts `I Omega theta'`, about y
    `-I Omega phi'` on the left of the equations of motion.
    """

    name: ClassVar[str] = "gyroscopic-coupling"
    polar_inertia: float = 0.0

    def mechanics(self, mechanics: Mechanics, geometry: Geometry, rotor_speed: float) -> Mechanics:
        """The equations with the coupling at this rotor speed."""
        momentum = self.polar_inertia * 2 * np.pi * rotor_speed
        coupling = np.zeros((6, 6))
        phi, theta = FREEDOMS.index("phi"), FREEDOMS.index("theta")
        coupling[phi, theta], coupling[theta, phi] = momentum, -momentum
        return replace(mechanics, damping=mechanics.damping + mechanics.plate.T @ coupling @ mechanics.plate)


@dataclass(frozen=True)
class GravityStiffness(Extension):
    """The center of gravity stands above the cells that carry the weight: `stiffness` is weight times height [N m/rad].

    As the plate tilts, the weight turns it further.
    """

    name: ClassVar[str] = "gravity-stiffness"
    stiffness: float = 0.0

    def mechanics(self, mechanics: Mechanics, geometry: Geometry, rotor_speed: float) -> Mechanics:
        """The equations with the moment of the weight about both horizontal axes."""
        tilts = mechanics.plate[[FREEDOMS.index("theta"), FREEDOMS.index("phi")]]
        return replace(mechanics, stiffness=mechanics.stiffness - self.stiffness * tilts.T @ tilts)
