"""Residuals of the equations of motion with the measured forces of the cells, the motion of each line eliminated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch
from balance_cli.estimation.equation_error import MIN_ARM, MeasuredForces, measured_forces
from balance_cli.estimation.recorded_loads import attached_exciters
from balance_cli.estimation.regression_residual import (
    MAX_START_LINES,
    RegressionResidual,
    batched_least_squares,
    every_nth_line,
    line_stride,
)
from balance_cli.model.exciter_loads import attach_exciters, loads_without_reaction, loads_without_reaction_derivatives
from balance_cli.model.response_jacobian import multiply_derivatives
from balance_cli.model.system import System, dynamic_stiffness

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

# Least load of a line relative to the median of its run: a line below it would weigh noise as much as signal.
MIN_LOAD_RATIO = 0.05


@dataclass(frozen=True)
class _MotionLines:
    """Lines of one rotor speed: frequency (K,) [Hz], forces (K, r) of springs `rows`, loads (K, 6), weights (K, n + r).

    `is_static`: no exciter applied the loads; `attached` (6,): the exciters that resist the motion of the hub.
    """

    spin: float
    is_static: bool
    attached: NDArray[np.bool_]
    frequency: Array
    rows: Index
    forces: ComplexArray
    loads: ComplexArray
    weight: Array

    @property
    def quadrature(self) -> ComplexArray:
        """1j where there is motion, else 0, (K, 1)."""
        return 1j * np.sign(self.frequency)[:, None]

    def log_frequency_ratio(self, system: System) -> Array:
        """ln(f / f0) (K, 1), the factor of the frequency-dependent stiffness."""
        return system.pencil.log_frequency_ratio(self.frequency)[:, None]


def motion_residuals(
    batches: Sequence[Batch], start: System, max_frequency: float = np.inf, max_lines: int = MAX_START_LINES
) -> list[Callable[[System], RegressionResidual]]:
    """Residuals of the lines up to `max_frequency` [Hz], about `max_lines` of them where there are more."""
    stride = line_stride(batches, max_frequency, max_lines)
    return [
        residual
        for batch in batches
        if batch.frequency[0] <= max_frequency
        for residual in _build_motion_residuals(batch, start, stride, max_frequency)
    ]


def _build_motion_residuals(
    batch: Batch, start: System, stride: int, max_frequency: float
) -> list[Callable[[System], RegressionResidual]]:
    """The residuals of equations of motion and readings after the motion of each line has been fitted to both.

    One for each set of exciters that are attached, where these resist the motion.
    """
    selection = every_nth_line(batch, stride, max_frequency)
    selection = selection[loaded_lines(batch)[selection]]
    measured = measured_forces(batch, start)
    resist = not batch.is_static and attach_exciters(start, np.ones(6, bool)) is not start
    attached = attached_exciters(batch)[selection] & resist
    sets, index = np.unique(attached, axis=0, return_inverse=True)
    return [
        partial(_motion_residual, lines=_motion_lines(batch, start, measured, selection[index.reshape(-1) == i], one))
        for i, one in enumerate(sets)
    ]


def _motion_lines(
    batch: Batch, start: System, measured: MeasuredForces, selection: Index, attached: NDArray[np.bool_]
) -> _MotionLines:
    frequency, loads = measured.frequency[selection], measured.loads[selection]
    weight = _motion_row_weight(start, frequency, loads, len(measured.rows))
    forces = measured.forces[selection]
    return _MotionLines(measured.spin, batch.is_static, attached, frequency, measured.rows, forces, loads, weight)


def loaded_lines(batch: Batch) -> NDArray[np.bool_]:
    """Return the mask (K,) of lines with enough load; the mean of a sweep, without any, would weigh its noise."""
    level = np.sqrt(np.sum(np.abs(batch.lines.loads) ** 2, axis=1))
    median = np.array([np.median(level[part]) if part.stop > part.start else 0.0 for part in batch.parts])
    return np.asarray(level > MIN_LOAD_RATIO * median[batch.lines.run])


def _motion_residual(system: System, lines: _MotionLines) -> RegressionResidual:
    system = attach_exciters(system, lines.attached) if lines.attached.any() else system
    A = dynamic_stiffness(system.pencil, lines.frequency, lines.spin)
    of_forces, of_loss = system.readings[lines.rows], system.readings_loss[lines.rows]
    of_frequency_stiffness = system.readings_frequency_stiffness[lines.rows]
    R = of_forces.value + lines.quadrature[:, :, None] * of_loss.value
    ratio = lines.log_frequency_ratio(system)
    R = R + ratio[:, :, None] * of_frequency_stiffness.value
    matrix = np.concatenate([A, R], axis=1) * lines.weight[:, :, None]
    driven = (system.equations, lines.frequency, lines.loads, lines.is_static)
    true_loads = loads_without_reaction(*driven)
    measured = np.concatenate([true_loads @ system.inputs.value.T, lines.forces], axis=1) * lines.weight
    x = batched_least_squares(matrix, measured[:, :, None])[:, :, 0]
    error = measured - np.matmul(matrix, x[:, :, None])[:, :, 0]

    def derivatives() -> ComplexArray:
        excitation = multiply_derivatives(system.inputs.derivative, true_loads)
        own, of_loads = loads_without_reaction_derivatives(*driven)
        excitation[:, :, own] += np.matmul(system.inputs.value, of_loads)
        readings = multiply_derivatives(of_forces.derivative, x)
        readings = readings + multiply_derivatives(of_loss.derivative, lines.quadrature * x)
        readings = readings + multiply_derivatives(of_frequency_stiffness.derivative, ratio * x)
        change = (
            np.concatenate([excitation - _pencil_derivative_product(system, lines, x), -readings], axis=1)
            * lines.weight[:, :, None]
        )
        return np.asarray(change - np.matmul(matrix, batched_least_squares(matrix, change)))

    return RegressionResidual(error, derivatives)


def _pencil_derivative_product(system: System, lines: _MotionLines, x: ComplexArray) -> ComplexArray:
    """The derivatives of A times x (K, n, p)."""
    pencil, w = system.pencil, 2 * np.pi * lines.frequency[:, None]
    damping = pencil.damping_derivative(lines.spin)
    matrices = (
        pencil.stiffness.derivative,
        damping,
        -pencil.mass.derivative,
        pencil.hysteresis.derivative,
        pencil.frequency_stiffness.derivative,
    )
    vectors = (x, 1j * w * x, w**2 * x, lines.quadrature * x, lines.log_frequency_ratio(system) * x)
    return multiply_derivatives(np.concatenate(matrices, axis=2), np.concatenate(vectors, axis=1))


def _motion_row_weight(system: System, frequency: Array, loads: ComplexArray, forces: int) -> Array:
    """Weights (K, n + r): the inverse of the size by which the error of each row is scaled.

    For the plate the size is the load of the line times the arm of each coordinate, growing as k + w^2 m (otherwise the
    highest frequencies, where inertia dominates, would decide alone). The equation of a flexible part is one of its own
    deflection: there the size is the deflection that changes a reading by the load.
    """
    level = np.sqrt(np.sum(np.abs(loads) ** 2, axis=1))[:, None]
    influence = np.abs(system.readings.value).max(axis=0)
    deflection = np.where(influence > 0, 1.0 / np.where(influence > 0, influence, 1.0), 0.0)
    flexible = system.equations.own_stiffness > 0
    arms = np.maximum(np.abs(system.inputs.value).max(axis=1), MIN_ARM)
    ratio = np.abs(np.diag(system.pencil.mass.value) / np.diag(system.pencil.stiffness.value))
    growth = 1.0 + (2 * np.pi * frequency[:, None]) ** 2 * ratio
    size = np.where(flexible, np.maximum(deflection, system.equations.row_factor.value), arms * growth)
    return np.asarray(1.0 / np.concatenate([level * size, np.repeat(level, forces, axis=1)], axis=1))
