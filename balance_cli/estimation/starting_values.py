"""Where a fit with effects begins: channels aligned with one another, then the equations of motion as a regression.

Far from the truth the likelihood has many minima, for resonances must first be brought to lie over one another. Two
estimates have hardly any, and come first:

1. Channels of one spring read the same force f, whatever the plate does: y_i = g_i f. With f eliminated line by line,
   what is left of the y_i tells delays, gains and filters of one channel against the other.
2. The cells measure their own forces f, so the motion x of the balance, lower body and all, is nearly known. All
   equations of a line at once,

       A(w) x = F u,        R x = f,

   are more than the unknown x; with x eliminated by least squares, what is left is free of the plate's resonances.
   (With x taken from some of the equations exactly, it would have the poles of those.) Variable projection: Golub and
   Pereyra, SIAM J. Numer. Anal. 10 (1973) 413; the derivative is that of Kaufman, BIT 15 (1975) 49.

The motion of a flexible part is not measured, and its resonance stays. At low frequency it is only a deflection that
grows with w^2, so lines are taken in from there upwards, each band beginning where the one below it ended (as Bunks et
al., Geophysics 60 (1995) 1457, do with waves).

Both are biased by noise, as every equation error is, and serve as a start only. Of an effect that is hardly above the
noise the second says little: then it is better to begin with that effect where it stands, and the rest fitted round it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.equation_error import measured_forces
from balance_cli.estimation.gauss_newton import minimise
from balance_cli.estimation.likelihood import Curvature
from balance_cli.estimation.measurements import Batch
from balance_cli.model.parameters import ParameterSet
from balance_cli.model.system import System, channel_gains, dynamic_stiffness, log_gain_slopes, slopes_times

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# A start needs no more lines; beyond this number every second, third .. line serves.
ENOUGH_LINES = 600
# Scales within which effects are sought: what two channels share cannot be seen in their ratio, for one.
WITHIN = 100.0
# Scales within which an effect stays where it stands.
HELD = 1e-3
# Highest frequencies [Hz] of the bands that are taken in one after another where parts are flexible.
BANDS = (20.0, 40.0, 80.0, np.inf)
ROUNDS = 2


@dataclass(frozen=True)
class Residual:
    """Errors (K, m) of K lines with slopes (K, m, p)."""

    error: ComplexArray
    slope: ComplexArray


@dataclass(frozen=True)
class Starts:
    """Two full parameter vectors: effects where they stand with the rest fitted round them, and everything fitted."""

    held: Array
    freed: Array


def starting_values(
    parameters: ParameterSet, batches: Sequence[Batch], system: Callable[[Array], System], start: Array
) -> Starts:
    """Where to begin, from `start`; priors hold what the data leave open."""
    near = parameters_within(parameters, start, WITHIN)
    aligned = _minimum(near, [_alignment(batch, _stride(batches)) for batch in batches], system, start)
    known = system(aligned)
    held = _minimum(parameters_within(parameters, aligned, HELD), _motions(batches, known), system, aligned)
    freed = held
    for highest in BANDS if np.any(known.own_stiffness) else (np.inf,):
        freed = _minimum(near, _motions(batches, known, highest), system, freed)
    return Starts(held, freed)


def parameters_within(parameters: ParameterSet, start: Array, scales: float) -> ParameterSet:
    """The same parameters, none without a prior: those that had none are held within so many scales of `start`."""
    unknown = np.isinf(parameters.sigma)
    sigma = np.where(unknown, scales * parameters.scale, parameters.sigma)
    return replace(parameters, value=np.where(unknown, start, parameters.value), sigma=sigma)


def _minimum(
    parameters: ParameterSet,
    residuals: Sequence[Callable[[System], Residual]],
    system: Callable[[Array], System],
    start: Array,
) -> Array:
    """Least squares with the priors; the variance is that of the residual itself, taken anew in each round."""

    def found(theta: Array) -> list[Residual]:
        at = system(theta)
        return [residual(at) for residual in residuals]

    def squares(theta: Array) -> float:
        return float(sum(np.sum(np.abs(item.error) ** 2) for item in found(theta)))

    count = sum(item.error.size for item in found(start))
    for _ in range(ROUNDS if count else 0):
        variance = max(squares(start) / count, np.finfo(float).tiny)
        start = minimise(
            parameters,
            start,
            lambda theta, v=variance: _curvature(found(theta), v),  # type: ignore[misc]
            lambda theta, v=variance: 2.0 * squares(theta) / v,  # type: ignore[misc]
            iterations=20,
            tolerance=1e-4 * count,
        ).theta
    return start


def _curvature(residuals: Sequence[Residual], variance: float) -> Curvature:
    p = residuals[0].slope.shape[2]
    total = Curvature(0.0, np.zeros(p), np.zeros((p, p)))
    for item in residuals:
        slope, error = item.slope.reshape(-1, p), item.error.reshape(-1)
        information = 2.0 * np.real(slope.conj().T @ slope) / variance
        gradient = 2.0 * np.real(slope.conj().T @ error) / variance
        total = total + Curvature(2.0 * float(np.sum(np.abs(error) ** 2)) / variance, gradient, information)
    return total


# ---- channels of one spring ------------------------------------------------------------------------------------------


def _alignment(batch: Batch, stride: int) -> Callable[[System], Residual]:
    """What is left of the channels of each spring once its force has been fitted to them, over their noise."""
    lines = _every(batch, stride)
    weight = np.sqrt(_precision(batch)[lines])
    index, measured = batch.index[lines], batch.channels[lines] * weight

    def residual(system: System) -> Residual:
        gains = channel_gains(system.paths, batch.frequency)[index]
        slopes = gains[:, :, None] * log_gain_slopes(system.paths, batch.frequency)[index]
        parts = [
            _projected(
                weight[:, mine, None] * gains[:, mine, None], measured[:, mine], weight[:, mine], slopes[:, mine]
            )
            for mine in _channels_of_springs(system)
        ]
        return _joined(parts, len(lines), system.parameters)

    return residual


def _channels_of_springs(system: System) -> list[list[int]]:
    springs = [path.spring for path in system.paths]
    groups = [[i for i, spring in enumerate(springs) if spring == one] for one in dict.fromkeys(springs)]
    return [group for group in groups if len(group) > 1]


def _projected(matrix: ComplexArray, measured: ComplexArray, weight: Array, slopes: ComplexArray) -> Residual:
    """The part of `measured` (K, m) that no force explains, and its slopes: the force times those of the gains."""
    force = _solved(matrix, measured[:, :, None])[:, :, 0]
    error = measured - np.matmul(matrix, force[:, :, None])[:, :, 0]
    change = -weight[:, :, None] * slopes * force[:, :, None]
    return Residual(error, change - np.matmul(matrix, _solved(matrix, change)))


def _joined(parts: Sequence[Residual], lines: int, p: int) -> Residual:
    nothing = Residual(np.zeros((lines, 0), complex), np.zeros((lines, 0, p), complex))
    whole = [nothing, *parts]
    return Residual(
        np.concatenate([item.error for item in whole], axis=1), np.concatenate([item.slope for item in whole], axis=1)
    )


# ---- equations of motion ---------------------------------------------------------------------------------------------


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


def _motions(batches: Sequence[Batch], start: System, highest: float = np.inf) -> list[Callable[[System], Residual]]:
    """The equations of motion of the lines up to `highest` [Hz]."""
    stride = _stride(batches, highest)
    return [_motion(batch, start, stride, highest) for batch in batches if batch.frequency[0] <= highest]


def _motion(batch: Batch, start: System, stride: int, highest: float) -> Callable[[System], Residual]:
    """What is left of the equations of motion and the readings once the motion of each line has been fitted to both."""
    measured, chosen = measured_forces(batch, start), _every(batch, stride, highest)
    frequency, loads = measured.frequency[chosen], measured.loads[chosen]
    weight = _row_weight(start, frequency, loads)
    lines = _Lines(measured.spin, frequency, measured.forces[chosen], loads, weight)
    return lambda system: _motion_residual(system, lines)


def _motion_residual(system: System, lines: _Lines) -> Residual:
    A = dynamic_stiffness(system.pencil, lines.frequency, lines.spin)
    R = system.readings.value + lines.lag[:, :, None] * system.readings_loss.value
    matrix = np.concatenate([A, R], axis=1) * lines.weight[:, :, None]
    true_loads = lines.loads @ system.spill.value.T
    known = np.concatenate([true_loads @ system.inputs.value.T, lines.forces], axis=1) * lines.weight
    x = _solved(matrix, known[:, :, None])[:, :, 0]
    error = known - np.matmul(matrix, x[:, :, None])[:, :, 0]
    driven = slopes_times(system.inputs.slope, true_loads)
    driven = driven + np.matmul(system.inputs.value, slopes_times(system.spill.slope, lines.loads))
    read = slopes_times(system.readings.slope, x) + slopes_times(system.readings_loss.slope, lines.lag * x)
    change = np.concatenate([driven - _pencil_slopes(system, lines, x), -read], axis=1) * lines.weight[:, :, None]
    return Residual(error, change - np.matmul(matrix, _solved(matrix, change)))


def _pencil_slopes(system: System, lines: _Lines, x: ComplexArray) -> ComplexArray:
    """DA x (K, n, p)."""
    pencil, w = system.pencil, 2 * np.pi * lines.frequency[:, None]
    damping = pencil.damping.slope + 2 * np.pi * lines.spin * pencil.gyroscopic.slope
    matrices = (pencil.stiffness.slope, damping, -pencil.mass.slope, pencil.hysteresis.slope)
    vectors = (x, 1j * w * x, w**2 * x, lines.lag * x)
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


# ---- shared ----------------------------------------------------------------------------------------------------------


def _stride(batches: Sequence[Batch], highest: float = np.inf) -> int:
    """Which lines up to `highest` [Hz] are enough: every one, every second ..."""
    lines = sum(int(np.sum(batch.frequency[batch.index] <= highest)) for batch in batches)
    return 1 + lines // ENOUGH_LINES


def _every(batch: Batch, stride: int, highest: float = np.inf) -> NDArray[np.intp]:
    """Every `stride`-th line up to `highest` [Hz]; all at frequency zero, which are few."""
    frequency = batch.frequency[batch.index]
    below = np.flatnonzero(frequency <= highest)
    return np.asarray(below[(frequency[below] == 0) | (np.arange(len(below)) % stride == 0)])


def _precision(batch: Batch) -> Array:
    c = batch.channels.shape[1]
    return np.real(np.diagonal(batch.precision[:, :c, :c], axis1=1, axis2=2))


def _solved(matrix: ComplexArray | Array, right: ComplexArray | Array) -> ComplexArray:
    """Least squares (K, n, r) of matrices (K, m, n), columns scaled; by the normal equations, as a start allows."""
    size = np.sqrt(np.sum(np.abs(matrix) ** 2, axis=1))
    scaled = matrix / np.where(size > 0, size, 1.0)[:, None, :]
    transposed = scaled.conj().swapaxes(1, 2)
    normal = np.matmul(transposed, scaled)
    normal[:, range(normal.shape[1]), range(normal.shape[1])] += 1e-13
    return np.asarray(np.linalg.solve(normal, np.matmul(transposed, right)) / np.where(size > 0, size, 1.0)[:, :, None])
