"""The n sensors of the paper's form: single cells, and the resultant of two parallel cells (s_z34).

Notes are those of docs/theory/paper-notes.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.model.plate import PlateMatrices, plate_matrices

Array = NDArray[np.float64]

PARALLEL_TOLERANCE = 1e-6
"""Axes whose unit vectors differ by less than this are parallel."""
CONDITION_MARGIN = 10.0
"""Largest condition of the P of a pair relative to that of the best pair: one digit of accuracy is given up at most."""
MAX_CONDITION = 1e6
"""Condition of the scaled P beyond which the sensors do not determine the motion: six of sixteen digits are lost."""


@dataclass(frozen=True)
class SensorRule:
    """The n sensor forces s = `matrix` (n, cells) times the forces of the cells.

    `names` (n,) of the sensors; `merged` names the two cells whose resultant is one sensor, empty where n cells
    measure n freedoms; `condition` is that of P = matrix C B with unit rows and columns.
    """

    names: tuple[str, ...]
    cells: tuple[str, ...]
    matrix: Array
    merged: tuple[str, ...]
    condition: float


def sensor_rule(geometry: Geometry) -> SensorRule:
    """Select the sensors of the paper's form: n cells for n freedoms, or n + 1 of which two parallel ones are merged.

    Of the parallel pairs the last in declared order is used whose P is about as well conditioned as the best pair's.
    The sum is exact: c3 d3 + c4 d4 = (c3 + c4) d(p) at the stiffness-weighted mean p of the two positions (note 6).

    Raises UserError where the number of cells does not fit, no two are parallel, or the sensors leave P singular.
    """
    if any(meter.name or meter.axis != "z" or meter.carried_by != "ground" for meter in geometry.shaft_meters):
        raise _unsupported_rig("it knows one torque meter, in a shaft about z beside the plate")
    plate, n, cells = plate_matrices(geometry), len(geometry.freedom), len(geometry.cells)
    if cells == n:
        best = _build_rule(geometry, plate, None)
    elif cells == n + 1:
        best = _select_merged_pair(geometry, plate)
    else:
        raise _unsupported_rig(f"{cells} cells for {n} freedoms; it needs {n}, or {n + 1} of which two are parallel")
    if best.condition > MAX_CONDITION:
        raise _unsupported_rig("the cells do not determine the motion of the plate")
    return best


def _select_merged_pair(geometry: Geometry, plate: PlateMatrices) -> SensorRule:
    axes = [cell.direction for cell in geometry.cells]
    parallel = [(i, j) for j, i in combinations(range(len(axes))[::-1], 2) if _are_parallel(axes[i], axes[j])]
    if not parallel:
        raise _unsupported_rig("one cell more than freedoms, but no two cells have parallel axes and could be merged")
    rules = [_build_rule(geometry, plate, pair) for pair in parallel]
    least = min(rule.condition for rule in rules)
    return next(rule for rule in rules if rule.condition <= CONDITION_MARGIN * least)


def _are_parallel(a: Array, b: Array) -> bool:
    return bool(np.linalg.norm(np.cross(a, b)) < PARALLEL_TOLERANCE)


def _unsupported_rig(fault: str) -> UserError:
    return UserError(f"the paper's form does not fit this rig: {fault}", place="cells", remedy="Use `--form physical`")


def _build_rule(geometry: Geometry, plate: PlateMatrices, pair: tuple[int, int] | None) -> SensorRule:
    names, matrix = list(geometry.cell_names), np.eye(len(geometry.cells))
    merged: tuple[str, ...] = ()
    if pair is not None:
        i, j = pair
        # Opposite axes: the resultant along the first one's axis is the difference of the two readings.
        matrix[i, j] = np.sign(geometry.cells[i].direction @ geometry.cells[j].direction)
        matrix = np.delete(matrix, j, axis=0)
        merged = (names[i], names[j])
        names[i] = _resultant_name(*merged)
        del names[j]
    P = sensor_matrix(matrix, plate)
    return SensorRule(tuple(names), geometry.cell_names, matrix, merged, _scaled_condition(P))


def sensor_matrix(merge: Array, plate: PlateMatrices) -> Array:
    """P (n, n) [N per unit q]: s = P q, the merged form of C B (note 3)."""
    return np.asarray(merge @ (plate.C[:, None] * plate.B))


def _resultant_name(first: str, second: str) -> str:
    """z3 and z4 give z34."""
    same = [a == b for a, b in zip(first, second, strict=False)]
    common = first[: [*same, False].index(False)]
    rest = (first[len(common) :], second[len(common) :])
    return common + "".join(rest) if common and all(rest) else f"{first}+{second}"


def _scaled_condition(P: Array) -> float:
    P = P / np.linalg.norm(P, axis=1, keepdims=True)
    columns = np.linalg.norm(P, axis=0)
    if np.any(columns == 0.0):
        return float("inf")
    return float(np.linalg.cond(P / columns))
