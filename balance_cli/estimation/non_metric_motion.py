"""The motion of the non-metric side as cells and loads show it, line by line, and the mode in each of its motions.

The cells measure the motion q of the plate relative to the side they stand on. If that side moves by b (as a motion of
the plate's center of gravity), the equations of the plate read

    -w^2 M (q + b) + (K + j w D + ...) q = F u,    so that    b = (A(w) q - F u) / (w^2 M)

with the rigid balance A(w) = K + j w D - w^2 M. The forces of the cells on that side, K q, are known as well. The ratio
of both has no resonance of the balance. In each motion i of its center, a body on a spring alone has

    b_i = s f_i / (1 - (w / w_i)^2 + 2 j zeta w / w_i).

Errors of the declared cells look like a part of b in proportion to f_i, which is fitted beside. With both linear, the
frequency w_i is the only unknown of a scan, which cannot end in a wrong minimum. Declared masses and cells are a few
percent wrong, and so is b; the modes are starting values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import FREEDOMS
from balance_cli.campaign.rig.kinematics import motion_at
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.equation_error import MeasuredForces, determines_motion, measured_forces
from balance_cli.estimation.equations_of_motion import loaded_lines
from balance_cli.model.effects.search_hints import BodyMode
from balance_cli.model.exciter_loads import loads_without_reaction
from balance_cli.model.system import System, dynamic_stiffness

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

SCAN_DAMPING = 0.03
"""Damping ratio of the scan, above that of most structures: wide enough that a line is within each resonance."""
SCAN_STEP = 1.5 * SCAN_DAMPING
"""Relative step of its frequencies: the half widths of neighbors, twice the damping ratio each, overlap."""
BELOW_FIRST_LINE = 1.5
"""Factor by which a mode may be below the first line: beyond it the body is free, and its stiffness shows nowhere."""


@dataclass(frozen=True)
class NonMetricMotion:
    """Lines at `frequency` (K,) [Hz], per unit of their load: what a point (3,) [m] of the non-metric side does.

    `motion` (K, 6) [m, rad] is its own, `relative` (K, 6) that of the plate relative to it, and `forces` (K, 6)
    [N, N m] are those of the cells on it about the point; all in the order of the freedoms.
    """

    frequency: Array
    point: Array
    motion: ComplexArray
    relative: ComplexArray
    forces: ComplexArray

    def at(self, point: Array) -> NonMetricMotion:
        """Return the same at another point (3,) [m] of the non-metric side."""
        transform = np.eye(6)
        transform[:3] = motion_at(point - self.point)
        motion, relative = self.motion @ transform.T, self.relative @ transform.T
        return replace(
            self, point=point, motion=motion, relative=relative, forces=self.forces @ np.linalg.inv(transform)
        )


def non_metric_motion(batches: Sequence[Batch], system: System, cells: int) -> NonMetricMotion | None:
    """Return the motion at the plate's center of gravity; None where the cells do not determine that of the plate.

    `system`: a balance on a rigid non-metric side, whose first springs are its `cells`. Static runs show no motion.
    """
    sweeps = [batch for batch in batches if not batch.is_static]
    measured = [measured_forces(batch, system) for batch in sweeps]
    if not measured or not all(determines_motion(system, item) for item in measured):
        return None
    parts = [_lines(system, item, cells, loaded_lines(batch)) for item, batch in zip(measured, sweeps, strict=True)]
    frequency, *motions = (np.concatenate(part) for part in zip(*parts, strict=True))
    return NonMetricMotion(frequency, system.equations.center.value, *motions)


def _lines(
    system: System, measured: MeasuredForces, cells: int, loaded: NDArray[np.bool_]
) -> tuple[Array, ComplexArray, ComplexArray, ComplexArray]:
    """Frequency, motion, relative motion, and forces of the lines of a batch that are `loaded`, per unit of load."""
    equations, keep = system.equations, loaded & (measured.frequency > 0)
    level = np.sqrt(np.sum(np.abs(measured.loads[keep]) ** 2, axis=1))[:, None]
    q = (measured.forces @ np.linalg.pinv(system.readings.value[measured.rows]).T)[keep]
    A = dynamic_stiffness(system.pencil, measured.frequency[keep], measured.spin)
    loads = loads_without_reaction(equations, measured.frequency, measured.loads, measured.is_static)[keep]
    missing = np.matmul(A, q[:, :, None])[:, :, 0] - loads @ system.inputs.value.T
    w = 2 * np.pi * measured.frequency[keep, None]
    motion = np.linalg.solve(system.pencil.mass.value, missing.T).T / w**2
    E = equations.elongation.value[:cells]
    forces = q @ (E.T @ (equations.stiffness.value[:cells, None] * E)).T
    freedom = list(equations.freedom)
    six = [_as_six_columns(item / level, freedom) for item in (motion, q, forces)]
    return measured.frequency[keep], six[0], six[1], six[2]


def _as_six_columns(values: ComplexArray, freedom: Sequence[int]) -> ComplexArray:
    """The first columns of `values` (K, n) as those of the motions that they are, (K, 6)."""
    columns = np.zeros((len(values), 6), complex)
    columns[:, list(freedom)] = values[:, : len(freedom)]
    return columns


def body_modes(motion: NonMetricMotion, names: Sequence[str]) -> dict[str, BodyMode]:
    """Return the mode of a body in each of its motions `names` whose center is the point; none where none improves."""
    found = {name: _scan(motion, FREEDOMS.index(name)) for name in names}
    return {name: mode for name, mode in found.items() if mode is not None}


def _scan(motion: NonMetricMotion, i: int) -> BodyMode | None:
    """The mode of motion i that leaves the least of it, each line relative to the motions there."""
    size = np.abs(motion.motion[:, i]) + np.abs(motion.relative[:, i])
    moving = size > 0
    if not moving.any():
        return None
    f, size = motion.frequency[moving], size[moving]
    y, force = motion.motion[moving, i] / size, motion.forces[moving, i] / size
    lowest, highest = np.log(f.min() / BELOW_FIRST_LINE), np.log(f.max())
    modes = np.exp(np.arange(lowest, highest, SCAN_STEP))
    ratio = f / modes[:, None]
    resonant = force / (1 - ratio**2 + 2j * SCAN_DAMPING * ratio)
    compliance, explained = _second_of_two(y, force, resonant)
    best = int(np.argmax(np.where(compliance > 0, explained, -1.0)))
    if compliance[best] <= 0:
        return None
    return BodyMode(float(modes[best]), float(compliance[best]), float(explained[best]))


def _second_of_two(y: ComplexArray, first: ComplexArray, second: ComplexArray) -> tuple[Array, Array]:
    """The real factor (G,) of `second` (G, K) in y (K,) beside `first` (K,), and its share of what that one leaves."""

    def inner(a: ComplexArray, b: ComplexArray) -> Array:
        return np.asarray(np.sum(np.real(a.conj() * b), axis=-1))

    remaining = y - inner(first, y) / inner(first, first) * first
    new = second - (inner(first, second) / inner(first, first))[:, None] * first
    factor = inner(new, remaining) / inner(new, new)
    return factor, factor**2 * inner(new, new) / inner(remaining, remaining)
