"""Equations of motion of the true rig, `M q'' + D q' + K q = F u`, and the forces of the cells.

q holds the degrees of freedom of the plate's center of gravity, the twist of the shaft, and the coordinates that
extensions add.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MaxwellBranch:
    """A Maxwell branch: spring `stiffness` [N/m] and dashpot in series, relaxing with `time_constant` [s].

    It acts along `row` (n,), the elongation per coordinate. `cell` is the cell whose channels read it, or None.
    """

    row: Array
    stiffness: float
    time_constant: float
    cell: int | None = None


@dataclass(frozen=True)
class NonlinearCellForce:
    """A nonlinear force along a cell: `k2 d^2 + k3 d^3`, a slipping contact of `stick_stiffness` up to `limit` [N].

    The limits of the contact are `limit` times 1 + `asymmetry` and 1 - `asymmetry`; its force falls with the rate d' of
    d, by the factor `fast_share + (1 - fast_share) exp(-(d' / speed)^2)`. Stops of `stop_stiffness` touch on both sides
    where |d| exceeds `gap`. Dampers: `c2 |d'| d'` and `damping_difference |d'| / 2`.

    `read_by_channels`: the force acts inside the cell, whose channels read it; otherwise it acts beside the cell.
    """

    cell: int
    k2: float = 0.0
    k3: float = 0.0
    stick_stiffness: float = 0.0
    limit: float = 0.0
    asymmetry: float = 0.0
    fast_share: float = 1.0
    speed: float = 1.0
    stop_stiffness: float = 0.0
    gap: float = 0.0
    c2: float = 0.0
    damping_difference: float = 0.0
    read_by_channels: bool = False

    @property
    def needs_rate(self) -> bool:
        """Whether the force depends on the rate of elongation."""
        return self.fast_share != 1.0 or bool(self.c2 or self.damping_difference)

    @property
    def has_kinks(self) -> bool:
        """Whether the slope of the force jumps as the motion turns round."""
        return bool(self.limit or self.damping_difference)


@dataclass(frozen=True)
class Mechanics:
    """Equations of motion in n coordinates, six hub loads and c cells.

    `mass`, `damping`, `stiffness` (n, n), the stiffness without that of the cells; `loads` (n, 6) [1, m];
    `accelerometer_rows` (a, n): the motion [m] that each accelerometer follows;
    `cell_rows` (c, n): elongations d = rows q [m]; `cell_stiffness` (c,) [N/m]; `torque_rows` (t, n): torque [N m] of
    each meter per coordinate. `names` (n,) of the coordinates. `plate` (6, n): motion x y z psi theta phi of the plate
    at its center of gravity `cg` (3,); `carried` (6, n): that of the plate and of the shafts that it carries;
    `non_metric_motion` (6, n): that of the non-metric side at the rig's origin, zero where it is rigid.
    `plate_damping`: the damping of the plate by its damping ratios for a mass matrix of its f motions, the first
    coordinates, both (f, f). `cell_damping` (c,) [N s/m]: dashpots inside the cells, whose channels read their forces.
    """

    names: tuple[str, ...]
    mass: Array
    damping: Array
    stiffness: Array
    loads: Array
    cell_rows: Array
    cell_stiffness: Array
    torque_rows: Array
    plate: Array
    carried: Array
    non_metric_motion: Array
    cg: Array
    branches: tuple[MaxwellBranch, ...] = field(default=())
    forces: tuple[NonlinearCellForce, ...] = field(default=())
    plate_damping: Callable[[Array], Array] | None = None
    accelerometer_rows: Array = field(default_factory=lambda: np.zeros((0, 0)))
    cell_damping: Array | None = None

    @property
    def sensors(self) -> int:
        """Number of cells, torque meters and accelerometers."""
        return len(self.cell_rows) + len(self.torque_rows) + len(self.accelerometer_rows)

    @property
    def needs_rates(self) -> bool:
        """Whether any nonlinear force depends on the rate of elongation."""
        return any(force.needs_rate for force in self.forces)

    @property
    def size(self) -> int:
        """Number of coordinates n."""
        return len(self.names)

    def total_stiffness(self) -> Array:
        """Stiffness (n, n) of everything but the branches: `K + B' C B`."""
        total: Array = self.stiffness + self.cell_rows.T @ (self.cell_stiffness[:, None] * self.cell_rows)
        return total

    def plate_displacement(self, position: ArrayLike) -> Array:
        """Displacement (3, n) per coordinate of the plate at `position` (3,) in rig axes."""
        rows: Array = displacement_rows(np.subtract(position, self.cg)) @ self.plate
        return rows

    def non_metric_displacement(self, position: ArrayLike) -> Array:
        """Displacement (3, n) per coordinate of the non-metric side at `position` (3,) in rig axes."""
        rows: Array = displacement_rows(position) @ self.non_metric_motion
        return rows

    def with_springs(self, rows: Array, stiffness: Array) -> Mechanics:
        """The equations with springs (m,) [N/m] whose elongations are `rows` (m, n)."""
        return replace(self, stiffness=self.stiffness + rows.T @ (stiffness[:, None] * rows))

    def with_coordinates(self, names: tuple[str, ...]) -> Mechanics:
        """The equations with further coordinates, to which nothing is attached yet."""
        more = len(names)
        square = ((0, more), (0, more))
        wide = ((0, 0), (0, more))
        return replace(
            self,
            names=self.names + names,
            mass=np.pad(self.mass, square),
            damping=np.pad(self.damping, square),
            stiffness=np.pad(self.stiffness, square),
            loads=np.pad(self.loads, ((0, more), (0, 0))),
            cell_rows=np.pad(self.cell_rows, wide),
            torque_rows=np.pad(self.torque_rows, wide),
            plate=np.pad(self.plate, wide),
            carried=np.pad(self.carried, wide),
            non_metric_motion=np.pad(self.non_metric_motion, wide),
            branches=tuple(replace(b, row=np.pad(b.row, (0, more))) for b in self.branches),
        )


def displacement_rows(arm: ArrayLike) -> Array:
    """Displacement (3, 6) of a point at `arm` (3,) [m] from the center of gravity, per motion x y z psi theta phi.

    `(x + theta zeta - psi eta, y + psi xi - phi zeta, z + phi eta - theta xi)` (small rotations).
    """
    xi, eta, zeta = np.asarray(arm, float)
    return np.array(
        [
            [1, 0, 0, -eta, zeta, 0],
            [0, 1, 0, xi, 0, -zeta],
            [0, 0, 1, 0, -xi, eta],
        ],
        float,
    )


ROTATION_ROWS = np.array([[0, 0, 0, 0, 0, 1], [0, 0, 0, 0, 1, 0], [0, 0, 0, 1, 0, 0]], float)
"""Rotation (3, 6) about x, y, z per motion x y z psi theta phi."""


def body_mass(mass: float, inertia: Array) -> Array:
    """Mass matrix (6, 6) of a rigid body in the motions x y z psi theta phi of its center of gravity."""
    rotation = ROTATION_ROWS[:, 3:]
    return scipy.linalg.block_diag(mass * np.eye(3), rotation.T @ inertia @ rotation)


def modal_damping(mass: Array, stiffness: Array, ratios: Array) -> Array:
    """`D = M Phi diag(2 zeta omega) Phi' M`, Phi normalized to `Phi' M Phi = 1`, zeta by rising eigenfrequency."""
    squares, shapes = scipy.linalg.eigh(stiffness, mass)
    momentum = mass @ shapes
    damping: Array = momentum * (2 * ratios * np.sqrt(np.maximum(squares, 0.0))) @ momentum.T
    return damping
