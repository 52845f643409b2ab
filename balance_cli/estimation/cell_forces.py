"""Forces along the springs that are not linear in the elongation, from what the springs' own channels measured.

A spring's force r is known from its channels, r = k d + (what acts inside), so its elongation d is, at every instant;
and so are all forces f(d), as functions of time whose spectra enter the equations like measured loads. Noise on d
matters little: it is small, and f is a small part of what the cells carry.

Derivatives go along through time as jets of the few parameters that matter to a spring. While a force is null, only
its own strength matters.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch
from balance_cli.model.channel_gains import channel_gains, log_gain_derivative
from balance_cli.model.mechanics.dual_numbers import Dual, constant
from balance_cli.model.mechanics.equations import CellForce
from balance_cli.model.response_jacobian import output_jacobian
from balance_cli.model.system import System, log_frequency_ratio
from balance_cli.model.system_response import Solution, SpringInputs, extra_forces, solve, volts_of_forces
from balance_cli.signals.waveform_types import Waveform

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

MAX_NEWTON_ITERATIONS = 50
# Of the largest elongation: where Newton's method ends.
NEWTON_TOLERANCE = 1e-12


@dataclass(frozen=True)
class ForceDerivatives:
    """Derivatives (k, q) of one force by the parameters `columns` (q,)."""

    spring: int
    read: bool
    columns: Index
    derivative: ComplexArray


@dataclass(frozen=True)
class RunCellForces:
    """The forces in one run, at lines `index` of a solution: all together where there are any, derivatives one by one.

    `lines` are those of the run in its batch, `waveform` makes them from those at which the forces are.
    """

    lines: slice
    waveform: Waveform
    solution: Solution
    index: Index
    inputs: SpringInputs | None
    derivatives: tuple[ForceDerivatives, ...]

    def volts(self, system: System) -> ComplexArray:
        """What the channels (k, c) read of the forces, through the balance and at once."""
        if self.inputs is None:
            return np.zeros((1, len(system.equations.paths)), complex)
        read = extra_forces(system, self.solution, self.index, self.inputs)[
            :, [path.spring for path in system.equations.paths]
        ]
        return self._at_lines((self.solution.gains[self.index] * read) @ system.equations.mixing.value.T)

    def add_derivatives(self, system: System, total: ComplexArray) -> None:
        """Add to `total` (k, c, p) the derivatives of the volts."""
        loads = np.zeros((len(self.index), 6), complex)
        if self.inputs is not None:
            total += self._at_lines(output_jacobian(system, self.solution, self.index, loads, self.inputs))
        acting, read = volts_of_forces(system, self.solution)
        for one in self.derivatives:
            volts = acting[:, :, one.spring] + (read[:, :, one.spring] if one.read else 0.0)
            for place, column in enumerate(one.columns):
                total[:, :, column] += self._at_lines(volts[self.index] * one.derivative[:, place, None])

    def _at_lines(self, values: ComplexArray) -> ComplexArray:
        return self.waveform.combine_bins(values)


def cell_forces(batch: Batch, system: System, solution: Solution, derivatives: bool) -> tuple[RunCellForces, ...]:
    """The forces in every run of a batch, at its lines or (record by record) at their neighbours.

    LinAlgError where a cell would give way.
    """
    found = []
    for run in batch.runs:
        lines, waveform = run.lines, run.waveform
        if waveform is None or not system.equations.forces:
            continue
        if waveform.lines_are_bin_sums:
            own = solve(system, waveform.bin_frequency(), batch.spin)
            found.append(_run_cell_forces(lines, waveform, system, own, np.arange(len(own.frequency)), derivatives))
        else:
            found.append(_run_cell_forces(lines, waveform, system, solution, batch.lines.index[lines], derivatives))
    return tuple(found)


def record_cell_forces(waveform: Waveform, system: System, solution: Solution) -> RunCellForces:
    """The forces of one record at all lines of its waveform, without derivatives."""
    everything = np.arange(len(waveform.frequency))
    return _run_cell_forces(slice(None), waveform, system, solution, everything, derivatives=False)


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
    found: list[ForceDerivatives] = []
    for force, through_time, columns in _force_histories(waveform, system, derivatives):
        if force.values.value[0] != 0.0:
            amplitudes = waveform.to_bins(through_time.value)
            inputs.acting[:, force.spring] += amplitudes
            if force.read:
                inputs.read[:, force.spring] += amplitudes
        if derivatives and len(columns):
            derivative = waveform.to_bins(through_time.derivative.T)
            found.append(ForceDerivatives(force.spring, force.read, columns, derivative))
    present = any(force.values.value[0] != 0.0 for force in system.equations.forces)
    return RunCellForces(lines, waveform, solution, index, inputs if present else None, tuple(found))


def _force_histories(waveform: Waveform, system: System, derivatives: bool) -> Iterator[tuple[CellForce, Dual, Index]]:
    """Each force as a function of time, with slopes for the parameters `columns`."""
    for spring in dict.fromkeys(force.spring for force in system.equations.forces):
        forces = [force for force in system.equations.forces if force.spring == spring]
        present = [force for force in forces if force.values.value[0] != 0.0]
        columns = _influencing_parameters(system, spring, present) if derivatives else np.zeros(0, np.intp)
        d = _elongation(waveform, system, spring, present, columns)
        for force in forces:
            if force.values.value[0] != 0.0:
                yield force, _force_history(force, d, columns, waveform.is_periodic), columns
            elif derivatives:
                own = np.flatnonzero(force.values.derivative[:, 0])
                yield force, _force_history(force, constant(d.value, len(own)), own, waveform.is_periodic), own


def _force_history(force: CellForce, d: Dual, columns: Index, recurs: bool) -> Dual:
    values = _select_parameters(force.values, columns)
    return values[0] * force.shape(d, values, recurs)


def _select_parameters(dual: Dual, columns: Index) -> Dual:
    """The jet with slopes for some of the parameters only."""
    return Dual(dual.value, dual.derivative[columns])


def _influencing_parameters(system: System, spring: int, forces: Sequence[CellForce]) -> Index:
    """The parameters on which the forces at one spring depend; none where there are no forces."""
    if not forces:
        return np.zeros(0, np.intp)
    p = system.parameters
    jets = [force.values for force in forces] + [
        system.equations.stiffness[spring],
        system.equations.loss[spring],
        system.equations.frequency_stiffness[spring],
    ]
    jets += [system.equations.mixing, system.equations.channel_offset]
    for path in system.equations.paths:
        if path.spring == spring:
            jets += [path.gain, *path.low_pass, *path.high_pass, *([] if path.delay is None else [path.delay])]
    return np.flatnonzero(np.any([np.any(dual.derivative.reshape(p, -1), axis=1) for dual in jets], axis=0))


# ---- elongation ------------------------------------------------------------------------------------------------------


def _elongation(waveform: Waveform, system: System, spring: int, forces: Sequence[CellForce], columns: Index) -> Dual:
    """The elongation d (n,) of a spring through time, from k d + (forces inside) = what the channels read."""
    reading, derivative = _measured_spring_force(waveform, system, spring, columns)
    # With structural damping k (1 + j eta), stiffening with frequency, where there is motion.
    moving, rising = 1j * (waveform.frequency > 0), log_frequency_ratio(waveform.frequency)
    factor = (
        1.0 + moving * system.equations.loss.value[spring] + rising * system.equations.frequency_stiffness.value[spring]
    )
    of_loss, of_stiffening = (
        system.equations.loss.derivative[columns, spring],
        system.equations.frequency_stiffness.derivative[columns, spring],
    )
    change = moving[:, None] * of_loss + rising[:, None] * of_stiffening
    derivative = (derivative - (reading / factor)[:, None] * change) / factor[:, None]
    both = waveform.to_time_domain(np.concatenate([(reading / factor)[:, None], derivative], axis=1))
    force = Dual(both[:, 0], both[:, 1:].T)
    k = _select_parameters(system.equations.stiffness[spring], columns)
    internal_forces = [one for one in forces if one.read]
    if not internal_forces:
        return force * k.reciprocal()
    value = _solve_elongation(force.value, float(k.value), internal_forces, waveform.is_periodic)
    at = constant(value, len(columns))
    error = k * at - force
    for one in internal_forces:
        error = error + _force_history(one, at, columns, waveform.is_periodic)
    return Dual(
        value, -error.derivative / (k.value + _force_and_stiffness(internal_forces, value, waveform.is_periodic)[1])
    )


def _solve_elongation(reading: Array, k: float, internal_forces: Sequence[CellForce], recurs: bool) -> Array:
    """Elongation (n,) by Newton's method. LinAlgError where no elongation gives the reading."""
    d = reading / k
    for _ in range(MAX_NEWTON_ITERATIONS):
        force, derivative = _force_and_stiffness(internal_forces, d, recurs)
        if np.any(k + derivative <= 0.0):
            break
        step = (k * d + force - reading) / (k + derivative)
        d = d - step
        if np.abs(step).max() <= NEWTON_TOLERANCE * np.abs(d).max():
            return d
    raise np.linalg.LinAlgError("a cell gives way under its load")


def _force_and_stiffness(forces: Sequence[CellForce], d: Array, recurs: bool) -> tuple[Array, Array]:
    """Sum of forces (n,) that depend on the elongation d (n,) of the instant alone, and its derivative by d."""
    total = constant(np.zeros_like(d), 1)
    for force in forces:
        values = constant(force.values.value, 1)
        total = total + values[0] * force.shape(Dual(d, np.ones((1, len(d)))), values, recurs)
    return total.value, total.derivative[0]


def _measured_spring_force(
    waveform: Waveform, system: System, spring: int, columns: Index
) -> tuple[ComplexArray, ComplexArray]:
    """The spring's force (F,) as its channels read it, amplitudes at the waveform's lines, and slopes (F, q)."""
    mine = [i for i, path in enumerate(system.equations.paths) if path.spring == spring]
    paths = [system.equations.paths[i] for i in mine]
    gains = channel_gains(paths, waveform.frequency)
    weight = np.where(gains != 0.0, waveform.share[:, mine] / np.where(gains != 0.0, gains, 1.0), 0.0)
    still = np.where(waveform.frequency == 0, waveform.mean_factor, 0.0)[:, None]
    unmixing = np.linalg.inv(system.equations.mixing.value)
    volts = (waveform.volts - still * system.equations.channel_offset.value) @ unmixing.T
    parts = weight * volts[:, mine]
    derivative = np.zeros((len(parts), len(columns)), complex)
    s = np.asarray(2j * np.pi * waveform.frequency[:, None], complex)
    for i, path in enumerate(paths if len(columns) else []):
        derivative -= parts[:, i, None] * log_gain_derivative(path, s)[:, columns]
    offset = system.equations.channel_offset.derivative[columns]
    if offset.any():
        derivative -= still * (weight @ (unmixing @ offset.T)[mine])
    mixing = system.equations.mixing.derivative[columns]
    if mixing.any():
        derivative -= np.einsum("fi,qij,fj->fq", weight, (unmixing @ mixing)[:, mine], volts)
    return np.asarray(parts.sum(axis=1)), derivative
