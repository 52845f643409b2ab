"""Nonlinear forces along the springs, computed from the springs' own channels.

The forces are known functions of time (`force_histories`), whose spectra enter the equations like measured loads.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import MAX_DERIVATIVE_BYTES, Batch
from balance_cli.estimation.force_histories import force_histories
from balance_cli.estimation.shared_solutions import SharedSolutions
from balance_cli.model.mechanics.cell_force import CellForce
from balance_cli.model.response_jacobian import output_jacobian
from balance_cli.model.system import System
from balance_cli.model.system_response import Solution, SpringInputs, extra_forces, volts_of_forces
from balance_cli.signals.waveform_types import Waveform

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class ForceDerivatives:
    """Derivatives (k, q) of one force along `spring` by the parameters `columns` (q,); `read`: its channels read it."""

    spring: int
    read: bool
    columns: Index
    derivative: ComplexArray


@dataclass(frozen=True)
class RunCellForces:
    """The nonlinear forces in one run, at lines `index` of a solution; None of `inputs` where all forces are zero.

    `lines` are those of the run in its batch; the `waveform` combines the bins, at which the forces are, to lines.
    """

    lines: slice
    waveform: Waveform
    solution: Solution
    index: Index
    inputs: SpringInputs | None
    derivatives: tuple[ForceDerivatives, ...]

    def volts(self, system: System) -> ComplexArray:
        """Volts (k, c) due to the forces, by way of the balance and read directly."""
        if self.inputs is None:
            return np.zeros((1, len(system.equations.paths)), complex)
        read = extra_forces(system, self.solution, self.index, self.inputs)[
            :, [path.spring for path in system.equations.paths]
        ]
        return self._at_lines((self.solution.gains[self.index] * read) @ system.equations.mixing.value.T)

    def add_derivatives(self, system: System, total: ComplexArray) -> None:
        """Add the derivatives of the volts to `total` (k, c, p), in place."""
        if self.inputs is not None:
            self._add_derivatives_at_given_forces(system, self.inputs, total)
        acting, read = volts_of_forces(system, self.solution)
        volts_per_force: dict[tuple[int, bool], ComplexArray] = {}  # a score test has many forces along each spring
        for force in self.derivatives:
            place = (force.spring, force.read)
            if place not in volts_per_force:
                volts = acting[:, :, force.spring] + (read[:, :, force.spring] if force.read else 0.0)
                volts_per_force[place] = volts[self.index]
            for i, column in enumerate(force.columns):
                total[:, :, column] += self._at_lines(volts_per_force[place] * force.derivative[:, i, None])

    def _add_derivatives_at_given_forces(self, system: System, inputs: SpringInputs, total: ComplexArray) -> None:
        # A record has many more bins than lines where a few of its lines are scored by many parameters.
        def at_bins(bins: Index) -> ComplexArray:
            loads = np.zeros((len(bins), 6), complex)
            return output_jacobian(system, self.solution, self.index[bins], loads, inputs.select(bins))

        self.waveform.add_bins(total, at_bins, max(MAX_DERIVATIVE_BYTES // total[:1].nbytes, 1))

    def _at_lines(self, values: ComplexArray) -> ComplexArray:
        return self.waveform.combine_bins(values)


def cell_forces(
    batch: Batch, system: System, solution: Solution, derivatives: bool, shared: SharedSolutions
) -> tuple[RunCellForces, ...]:
    """Compute the nonlinear forces in every run of a batch, at the bins of its waveform.

    Raises LinAlgError where the stiffness of a cell would become negative, or its reading explain itself.
    """
    runs = []
    for run in batch.runs:
        lines, waveform = run.lines, run.waveform
        if waveform is None or not system.equations.forces:
            continue
        if waveform.lines_are_bin_sums:
            at_bins = shared.solution(waveform.bin_frequency(), batch.spin)
            index = np.arange(len(at_bins.frequency))
            runs.append(_run_cell_forces(lines, waveform, system, at_bins, index, derivatives))
        else:
            runs.append(_run_cell_forces(lines, waveform, system, solution, batch.lines.index[lines], derivatives))
    return tuple(runs)


def record_cell_forces(waveform: Waveform, system: System, solution: Solution) -> RunCellForces:
    """Compute the nonlinear forces of one record at all frequencies of its waveform, without derivatives."""
    index = np.arange(len(waveform.frequency))
    return _run_cell_forces(slice(None), waveform, system, solution, index, derivatives=False)


def _run_cell_forces(
    lines: slice,
    waveform: Waveform,
    system: System,
    solution: Solution,
    index: Index,
    derivatives: bool,
) -> RunCellForces:
    shape = (len(index), len(system.equations.stiffness.value))
    inputs = SpringInputs(np.zeros(shape, complex), np.zeros(shape, complex))
    force_derivatives: list[ForceDerivatives] = []
    for force, _, through_time, columns in force_histories(waveform, system, solution.spin, derivatives):
        if force.values.value[0] != 0.0:
            amplitudes = waveform.to_bins(through_time.value)
            inputs.acting[:, force.spring] += amplitudes
            if force.read:
                inputs.read[:, force.spring] += amplitudes
        if derivatives and len(columns):
            derivative = waveform.to_bins(through_time.derivative.T)
            force_derivatives.append(ForceDerivatives(force.spring, force.read, columns, derivative))
    present = any(force.values.value[0] != 0.0 for force in system.equations.forces)
    return RunCellForces(lines, waveform, solution, index, inputs if present else None, tuple(force_derivatives))


def record_force_histories(waveform: Waveform, system: System, spin: float) -> Iterator[tuple[CellForce, Array, Array]]:
    """Each force of a record that is not zero, with the elongation [m] of its spring and the force [N] in time (n,)."""
    for force, d, through_time, _ in force_histories(waveform, system, spin, derivatives=False):
        yield force, d, through_time.value
