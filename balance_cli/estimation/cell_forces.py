"""Nonlinear forces along the springs, computed from the springs' own channels.

The channels of a spring measure its force r = k d + (nonlinear forces inside), and so its elongation d at every
instant. Hence all forces f(d) are known functions of time, whose spectra enter the equations like measured loads. Noise
on d matters little: it is small, and f is a small part of the load of a cell.

Derivatives are carried through time as dual numbers of the few parameters that influence a spring. While a force is
zero, only its own strength has a derivative.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch
from balance_cli.estimation.shared_solutions import SharedSolutions
from balance_cli.model.channel_gains import channel_gains, log_gain_derivative
from balance_cli.model.mechanics.dual_numbers import Dual, constant
from balance_cli.model.mechanics.equations import CellForce
from balance_cli.model.response_jacobian import output_jacobian
from balance_cli.model.system import System
from balance_cli.model.system_response import Solution, SpringInputs, extra_forces, volts_of_forces
from balance_cli.signals.waveform_types import Waveform

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

# Newton's method converges quadratically where the stiffness stays positive; beyond this it has no solution.
MAX_NEWTON_ITERATIONS = 50
# Last step relative to the largest elongation: a thousand times the rounding of doubles.
NEWTON_TOLERANCE = 1e-12
# Rms of the nonlinear forces inside a cell over that of its reading. They are computed from the reading: at a share of
# one the reading would explain itself, whatever it is, and a load cell that is half nonlinear is none.
MAX_INTERNAL_SHARE = 0.5


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
        loads = np.zeros((len(self.index), 6), complex)
        if self.inputs is not None:
            total += self._at_lines(output_jacobian(system, self.solution, self.index, loads, self.inputs))
        acting, read = volts_of_forces(system, self.solution)
        volts_per_force: dict[tuple[int, bool], ComplexArray] = {}  # a score test has many forces along each spring
        for force in self.derivatives:
            place = (force.spring, force.read)
            if place not in volts_per_force:
                volts = acting[:, :, force.spring] + (read[:, :, force.spring] if force.read else 0.0)
                volts_per_force[place] = volts[self.index]
            for i, column in enumerate(force.columns):
                total[:, :, column] += self._at_lines(volts_per_force[place] * force.derivative[:, i, None])

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
    for force, _, through_time, columns in _force_histories(waveform, system, derivatives):
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


def record_force_histories(waveform: Waveform, system: System) -> Iterator[tuple[CellForce, Array, Array]]:
    """Each force of a record that is not zero, with the elongation [m] of its spring and the force [N] in time (n,)."""
    for force, d, through_time, _ in _force_histories(waveform, system, derivatives=False):
        yield force, d, through_time.value


def _force_histories(
    waveform: Waveform, system: System, derivatives: bool
) -> Iterator[tuple[CellForce, Array, Dual, Index]]:
    """Each force and its spring's elongation as functions of time; derivatives by the parameters `columns`."""
    unmixed = _unmix(waveform, system)
    for spring in dict.fromkeys(force.spring for force in system.equations.forces):
        forces = [force for force in system.equations.forces if force.spring == spring]
        present = [force for force in forces if force.values.value[0] != 0.0]
        columns = _influencing_parameters(system, spring, present) if derivatives else np.zeros(0, np.intp)
        d = _elongation(waveform, system, unmixed, spring, present, columns)
        for force in forces:
            if force.values.value[0] != 0.0:
                yield force, d.value, _force_history(force, d, columns, waveform.is_periodic), columns
            elif derivatives:
                own = np.flatnonzero(force.values.derivative[:, 0])
                shape = force.shape(constant(d.value, 0), constant(force.values.value, 0), waveform.is_periodic).value
                yield force, d.value, Dual(np.zeros_like(shape), force.values.derivative[own, 0, None] * shape), own


def _force_history(force: CellForce, d: Dual, columns: Index, is_periodic: bool) -> Dual:
    values = _select_parameters(force.values, columns)
    return values[0] * force.shape(d, values, is_periodic)


def _select_parameters(dual: Dual, columns: Index) -> Dual:
    """The dual number with derivatives by the given parameters only."""
    return Dual(dual.value, dual.derivative[columns])


def _influencing_parameters(system: System, spring: int, forces: Sequence[CellForce]) -> Index:
    """The parameters that influence the forces along one spring; none where there are no forces."""
    if not forces:
        return np.zeros(0, np.intp)
    p = system.parameters
    duals = [force.values for force in forces] + [
        system.equations.stiffness[spring],
        system.equations.loss[spring],
        system.equations.frequency_stiffness[spring],
    ]
    duals += [system.equations.mixing, system.equations.channel_offset]
    for path in system.equations.paths:
        if path.spring == spring:
            duals += path.dual_numbers
    return np.flatnonzero(np.any([np.any(dual.derivative.reshape(p, -1), axis=1) for dual in duals], axis=0))


# ---- elongation ------------------------------------------------------------------------------------------------------


def _elongation(
    waveform: Waveform,
    system: System,
    unmixed: _UnmixedVolts,
    spring: int,
    forces: Sequence[CellForce],
    columns: Index,
) -> Dual:
    """The elongation d (n,) of a spring through time, from k d + (forces inside) = the measured force."""
    force = _elastic_force(waveform, system, unmixed, spring, columns)
    k = _select_parameters(system.equations.stiffness[spring], columns)
    internal_forces = [item for item in forces if item.read]
    if not internal_forces:
        return force * k.reciprocal()
    value = _solve_elongation(force.value, float(k.value), internal_forces, waveform.is_periodic)
    if np.linalg.norm(force.value - float(k.value) * value) > MAX_INTERNAL_SHARE * np.linalg.norm(force.value):
        raise np.linalg.LinAlgError("nonlinear forces inside a cell are most of its reading")
    at = constant(value, len(columns))
    error = k * at - force
    for internal in internal_forces:
        error = error + _force_history(internal, at, columns, waveform.is_periodic)
    stiffness = k.value + _force_and_stiffness(internal_forces, value, waveform.is_periodic)[1]
    return Dual(value, -error.derivative / stiffness)


def _elastic_force(waveform: Waveform, system: System, unmixed: _UnmixedVolts, spring: int, columns: Index) -> Dual:
    """The measured force of a spring through time (n,), divided by 1 + j eta and the growth of k with frequency."""
    loss, growth = system.equations.loss, system.equations.frequency_stiffness
    reading, derivative = _measured_spring_force(waveform, system, unmixed, spring, columns)
    # Loss and growth hold only where there is motion.
    quadrature, logarithmic = 1j * (waveform.frequency > 0), system.pencil.log_frequency_ratio(waveform.frequency)
    factor = 1.0 + quadrature * loss.value[spring] + logarithmic * growth.value[spring]
    d_loss, d_growth = loss.derivative[columns, spring], growth.derivative[columns, spring]
    change = quadrature[:, None] * d_loss + logarithmic[:, None] * d_growth
    derivative = (derivative - (reading / factor)[:, None] * change) / factor[:, None]
    history = waveform.to_time_domain(np.concatenate([(reading / factor)[:, None], derivative], axis=1))
    return Dual(history[:, 0], history[:, 1:].T)


def _solve_elongation(reading: Array, k: float, internal_forces: Sequence[CellForce], is_periodic: bool) -> Array:
    """Elongation (n,) by Newton's method. Raises LinAlgError where no elongation gives the reading."""
    d = reading / k
    for _ in range(MAX_NEWTON_ITERATIONS):
        force, derivative = _force_and_stiffness(internal_forces, d, is_periodic)
        if np.any(k + derivative <= 0.0):
            break
        step = (k * d + force - reading) / (k + derivative)
        d = d - step
        if np.abs(step).max() <= NEWTON_TOLERANCE * np.abs(d).max():
            return d
    raise np.linalg.LinAlgError("the stiffness of a cell becomes negative under its load")


def _force_and_stiffness(forces: Sequence[CellForce], d: Array, is_periodic: bool) -> tuple[Array, Array]:
    """Sum of forces (n,) that depend on the present elongation d (n,) alone, and its derivative by d."""
    total = constant(np.zeros_like(d), 1)
    for force in forces:
        values = constant(force.values.value, 1)
        total = total + values[0] * force.shape(Dual(d, np.ones((1, len(d)))), values, is_periodic)
    return total.value, total.derivative[0]


@dataclass(frozen=True)
class _UnmixedVolts:
    """The channels' volts (F, c) before crosstalk and offsets, by the inverse (c, c) of the mixing.

    `constant` (F, 1): change of an amplitude per unit offset.
    """

    volts: ComplexArray
    inverse: Array
    constant: Array


def _unmix(waveform: Waveform, system: System) -> _UnmixedVolts:
    constant_volts = np.where(waveform.frequency == 0, waveform.mean_factor, 0.0)[:, None]
    inverse = np.linalg.inv(system.equations.mixing.value)
    volts = (waveform.volts - constant_volts * system.equations.channel_offset.value) @ inverse.T
    return _UnmixedVolts(volts, np.asarray(inverse, float), constant_volts)


def _measured_spring_force(
    waveform: Waveform, system: System, unmixed: _UnmixedVolts, spring: int, columns: Index
) -> tuple[ComplexArray, ComplexArray]:
    """Amplitudes (F,) of the spring's force as its channels read it, and their derivatives (F, q)."""
    own = [i for i, path in enumerate(system.equations.paths) if path.spring == spring]
    paths = [system.equations.paths[i] for i in own]
    gains = channel_gains(paths, waveform.frequency)
    weight = np.where(gains != 0.0, waveform.share[:, own] / np.where(gains != 0.0, gains, 1.0), 0.0)
    parts = weight * unmixed.volts[:, own]
    derivative = np.zeros((len(parts), len(columns)), complex)
    s = np.asarray(2j * np.pi * waveform.frequency[:, None], complex)
    for i, path in enumerate(paths if len(columns) else []):
        derivative -= parts[:, i, None] * log_gain_derivative(path, s)[:, columns]
    offset = system.equations.channel_offset.derivative[columns]
    if offset.any():
        derivative -= unmixed.constant * (weight @ (unmixed.inverse @ offset.T)[own])
    mixing = system.equations.mixing.derivative[columns]
    if mixing.any():
        derivative -= np.einsum("fi,qij,fj->fq", weight, (unmixed.inverse @ mixing)[:, own], unmixed.volts)
    return np.asarray(parts.sum(axis=1)), derivative
