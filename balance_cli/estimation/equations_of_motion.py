"""The equations of motion with the cells' forces: what is left of them once the motion of each line is fitted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.equation_error import measured_forces
from balance_cli.estimation.measurements import Batch
from balance_cli.estimation.regression_residual import ENOUGH_LINES, Residual, every, solved, sparsity
from balance_cli.model.system import System, dynamic_stiffness, rise, slopes_times

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Of the usual load of a run, the least that a line must have.
LEAST_LEVEL = 0.05


@dataclass(frozen=True)
class _Lines:
    """Lines of one rotor speed: frequency (K,) [Hz], spring forces (K, e), loads (K, 6), weights (K, n + e)."""

    spin: float
    frequency: Array
    forces: ComplexArray
    loads: ComplexArray
    weight: Array

    @property
    def lag(self) -> ComplexArray:
        """1j where there is motion, (K, 1)."""
        return 1j * np.sign(self.frequency)[:, None]

    @property
    def rise(self) -> Array:
        """The logarithm of frequency by which springs stiffen, (K, 1)."""
        return rise(self.frequency)[:, None]


def motions(
    batches: Sequence[Batch], start: System, highest: float = np.inf, enough: int = ENOUGH_LINES
) -> list[Callable[[System], Residual]]:
    """The equations of motion of the lines up to `highest` [Hz], at least `enough` of them where there are so many."""
    stride = sparsity(batches, highest, enough)
    return [_motion(batch, start, stride, highest) for batch in batches if batch.frequency[0] <= highest]


def _motion(batch: Batch, start: System, stride: int, highest: float) -> Callable[[System], Residual]:
    """What is left of the equations of motion and the readings once the motion of each line has been fitted to both."""
    chosen = every(batch, stride, highest)
    chosen = chosen[_driven(batch)[chosen]]
    measured = measured_forces(batch, start)
    frequency, loads = measured.frequency[chosen], measured.loads[chosen]
    weight = _row_weight(start, frequency, loads)
    lines = _Lines(measured.spin, frequency, measured.forces[chosen], loads, weight)
    return lambda system: _motion_residual(system, lines)


def _driven(batch: Batch) -> NDArray[np.bool_]:
    """Lines (K,) with a load to speak of: not the mean of a swept record, whose weight would be that of noise alone."""
    level = np.sqrt(np.sum(np.abs(batch.loads) ** 2, axis=1))
    usual = np.array([np.median(level[part]) if part.stop > part.start else 0.0 for part in batch.parts])
    return np.asarray(level > LEAST_LEVEL * usual[batch.run])


def _motion_residual(system: System, lines: _Lines) -> Residual:
    A = dynamic_stiffness(system.pencil, lines.frequency, lines.spin)
    R = system.readings.value + lines.lag[:, :, None] * system.readings_loss.value
    R = R + lines.rise[:, :, None] * system.readings_stiffening.value
    matrix = np.concatenate([A, R], axis=1) * lines.weight[:, :, None]
    true_loads = lines.loads @ system.spill.value.T
    known = np.concatenate([true_loads @ system.inputs.value.T, lines.forces], axis=1) * lines.weight
    x = solved(matrix, known[:, :, None])[:, :, 0]
    error = known - np.matmul(matrix, x[:, :, None])[:, :, 0]

    def slopes() -> ComplexArray:
        driven = slopes_times(system.inputs.slope, true_loads)
        driven = driven + np.matmul(system.inputs.value, slopes_times(system.spill.slope, lines.loads))
        read = slopes_times(system.readings.slope, x) + slopes_times(system.readings_loss.slope, lines.lag * x)
        read = read + slopes_times(system.readings_stiffening.slope, lines.rise * x)
        change = np.concatenate([driven - _pencil_slopes(system, lines, x), -read], axis=1) * lines.weight[:, :, None]
        return np.asarray(change - np.matmul(matrix, solved(matrix, change)))

    return Residual(error, slopes)


def _pencil_slopes(system: System, lines: _Lines, x: ComplexArray) -> ComplexArray:
    """DA x (K, n, p)."""
    pencil, w = system.pencil, 2 * np.pi * lines.frequency[:, None]
    damping = pencil.damping.slope + 2 * np.pi * lines.spin * pencil.gyroscopic.slope
    matrices = (
        pencil.stiffness.slope,
        damping,
        -pencil.mass.slope,
        pencil.hysteresis.slope,
        pencil.stiffening.slope,
    )
    vectors = (x, 1j * w * x, w**2 * x, lines.lag * x, lines.rise * x)
    return slopes_times(np.concatenate(matrices, axis=2), np.concatenate(vectors, axis=1))


def _row_weight(system: System, frequency: Array, loads: ComplexArray) -> Array:
    """One over the size (K, n + e) of an error that matters.

    For the plate it is the load of the line, times the arm of each coordinate, growing as k + w^2 m does (or else the
    highest frequencies, where inertia is everything, would decide alone). The equation of a flexible part is one of
    its own deflection: there it is the deflection that changes a reading by the load.
    """
    level = np.sqrt(np.sum(np.abs(loads) ** 2, axis=1))[:, None]
    readable = np.abs(system.readings.value).max(axis=0)
    deflection = np.where(readable > 0, 1.0 / np.where(readable > 0, readable, 1.0), 0.0)
    flexible = system.own_stiffness > 0
    arms = np.maximum(np.abs(system.inputs.value).max(axis=1), 1e-3)
    ratio = np.abs(np.diag(system.pencil.mass.value) / np.diag(system.pencil.stiffness.value))
    growth = 1.0 + (2 * np.pi * frequency[:, None]) ** 2 * ratio
    size = np.where(flexible, np.maximum(deflection, system.row_factor), arms * growth)
    return np.asarray(
        1.0 / np.concatenate([level * size, np.repeat(level, len(system.readings.value), axis=1)], axis=1)
    )
