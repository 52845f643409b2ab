"""Effects in the cells: their axis and place, transverse stiffness and damping."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.rig_scales import rig_frequency
from balance_cli.simulation.extensions.base import Extension
from balance_cli.simulation.mechanics import MaxwellBranch, Mechanics

Array = NDArray[np.float64]


def transverse_axes(axis: Array) -> tuple[Array, Array]:
    """Two unit vectors (3,) perpendicular to a unit `axis`: for a cell along x y and z, and so on in cyclic order.

    The first is the rig axis that follows the axis nearest to the cell's, made orthogonal to the cell's.
    """
    following = np.eye(3)[(int(np.argmax(np.abs(axis))) + 1) % 3]
    first = following - (following @ axis) * axis
    first = first / np.linalg.norm(first)
    return first, np.cross(axis, first)


@dataclass(frozen=True)
class CellMisalignment(Extension):
    """The cell is misaligned: its axis tilts by `angle_1` and `angle_2` [rad] towards its two transverse axes."""

    name: ClassVar[str] = "cell-misalignment"
    angle_1: float = 0.0
    angle_2: float = 0.0

    def mechanics(self, mechanics: Mechanics, geometry: Geometry, rotor_speed: float) -> Mechanics:
        """The equations with the cell's force and reading along the tilted axis."""
        rows = mechanics.cell_rows.copy()
        for index in self.places(geometry.cell_names):
            cell = geometry.cells[index]
            first, second = transverse_axes(cell.direction)
            axis = cell.direction + self.angle_1 * first + self.angle_2 * second
            relative = mechanics.plate_displacement(cell.position) - mechanics.non_metric_displacement(cell.position)
            rows[index] = axis / np.linalg.norm(axis) @ relative
        return replace(mechanics, cell_rows=rows)


@dataclass(frozen=True)
class CellPosition(Extension):
    """The cell acts `offset_1` and `offset_2` [m] beside its declared position, towards its two transverse axes."""

    name: ClassVar[str] = "cell-position"
    offset_1: float = 0.0
    offset_2: float = 0.0

    def mechanics(self, mechanics: Mechanics, geometry: Geometry, rotor_speed: float) -> Mechanics:
        """The equations with the cell at its true position."""
        rows = mechanics.cell_rows.copy()
        for index in self.places(geometry.cell_names):
            cell = geometry.cells[index]
            first, second = transverse_axes(cell.direction)
            true = np.array(cell.position) + self.offset_1 * first + self.offset_2 * second
            for point, sign in ((true, 1.0), (np.array(cell.position), -1.0)):
                relative = mechanics.plate_displacement(point) - mechanics.non_metric_displacement(point)
                rows[index] += sign * cell.direction @ relative
        return replace(mechanics, cell_rows=rows)


@dataclass(frozen=True)
class TransverseStiffness(Extension):
    """The cell has a transverse `stiffness` [N/m], whose force no channel reads."""

    name: ClassVar[str] = "transverse-stiffness"
    stiffness: float = 0.0

    def mechanics(self, mechanics: Mechanics, geometry: Geometry, rotor_speed: float) -> Mechanics:
        """The equations with two transverse springs at each cell."""
        for index in self.places(geometry.cell_names):
            cell = geometry.cells[index]
            across = np.array(transverse_axes(cell.direction))
            relative = mechanics.plate_displacement(cell.position) - mechanics.non_metric_displacement(cell.position)
            mechanics = mechanics.with_springs(across @ relative, np.full(2, self.stiffness))
        return mechanics


@dataclass(frozen=True)
class CellDashpot(Extension):
    """A force of `damping` [N s/m] times the rate of elongation beside the cell, whose channels do not read it."""

    name: ClassVar[str] = "cell-dashpot"
    damping: float = 0.0

    def mechanics(self, mechanics: Mechanics, geometry: Geometry, rotor_speed: float) -> Mechanics:
        """The equations with the dashpot at every place."""
        rows = mechanics.cell_rows[self.places(geometry.cell_names)]
        return replace(mechanics, damping=mechanics.damping + self.damping * rows.T @ rows)


@dataclass(frozen=True)
class ViscousDamping(Extension):
    """A dashpot inside the cell, of `damping_time` [s] times its stiffness, whose force its channels read."""

    name: ClassVar[str] = "viscous-damping"
    damping_time: float = 0.0

    def mechanics(self, mechanics: Mechanics, geometry: Geometry, rotor_speed: float) -> Mechanics:
        """The equations with the dashpot in every cell."""
        cells, count = self.places(geometry.cell_names), len(mechanics.cell_rows)
        inside = np.zeros(count) if mechanics.cell_damping is None else mechanics.cell_damping.copy()
        rows, dashpots = mechanics.cell_rows[cells], self.damping_time * mechanics.cell_stiffness[cells]
        inside[cells] += dashpots
        return replace(mechanics, damping=mechanics.damping + rows.T @ (dashpots[:, None] * rows), cell_damping=inside)


RELAXATION_RATIOS = np.geomspace(0.0025, 75.0, 10)
"""Relaxation frequencies of the Maxwell branches, of that in the middle of the modes: about two to a decade."""


@dataclass(frozen=True)
class StructuralDamping(Extension):
    """The cell's force lags its elongation by the `loss_factor` at every frequency about that of the modes.

    A chain of Maxwell branches of equal stiffness `(2 / pi) eta k ln(ratio of adjacent rates)`, the causal
    realization of `k (1 + j eta)`. It stiffens with frequency, by `(2 / pi) eta` for each factor e; at the frequency
    in the middle of the modes of the rig as declared the stiffness is that of the cell. The channels read the whole
    force. A time-domain model has no other choice: `causality` is 1, whatever value is given.
    """

    name: ClassVar[str] = "structural-damping"
    loss_factor: float = 0.0
    causality: float = 1.0

    def mechanics(self, mechanics: Mechanics, geometry: Geometry, rotor_speed: float) -> Mechanics:
        """The equations with the branches of each cell."""
        share = 2 / np.pi * self.loss_factor * np.log(RELAXATION_RATIOS[1] / RELAXATION_RATIOS[0])
        stored = share * np.sum(1 / (1 + RELAXATION_RATIOS**2))
        stiffness = mechanics.cell_stiffness.copy()
        branches = []
        for index in self.places(geometry.cell_names):
            k = mechanics.cell_stiffness[index]
            stiffness[index] = k * (1 - stored)
            taus = 1 / (2 * np.pi * rig_frequency(geometry) * RELAXATION_RATIOS)
            branches += [MaxwellBranch(mechanics.cell_rows[index], float(share * k), float(tau), index) for tau in taus]
        return replace(mechanics, cell_stiffness=stiffness, branches=(*mechanics.branches, *branches))
