"""Least squares on the equation error: the equations of motion with the measured forces inserted.

The cells measure their own forces s, so q = (kE)^+ s is known, and e = A(w) q - F u has no resonances: it is a
polynomial in the parameters, and a fit that starts at the declared values cannot converge to a wrong peak. Noise on s
biases it, as it does every equation error (paper, section 6). It serves as a start of the maximum likelihood.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.independence import has_independent_columns
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.inner_products import real_inner_product
from balance_cli.estimation.levenberg_marquardt import Minimum, minimize
from balance_cli.estimation.likelihood import Curvature
from balance_cli.model.channel_gains import channel_gains
from balance_cli.model.exciter_loads import loads_without_reaction, loads_without_reaction_derivatives
from balance_cli.model.parameters import ParameterSet
from balance_cli.model.response_jacobian import multiply_derivatives
from balance_cli.model.system import System, dynamic_stiffness

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

# Least arm of a coordinate per unit load [m/rad or 1]: keeps the weight of an unloaded coordinate finite.
MIN_ARM = 1e-3
# Rounds, each with the noise variance estimated from the residual of the one before: it sets the weight of the priors.
VARIANCE_ROUNDS = 3
# Beyond this number of lines every second, third ... is used: more lines do not reduce the bias of the estimate.
MAX_REGRESSION_LINES = 2000


@dataclass(frozen=True)
class MeasuredForces:
    """Forces (K, r) [N, N m] of the r springs `rows` that the channels of a batch measured, with loads (K, 6).

    `weight` (K, n + r) is the inverse of the size by which the errors of the equations are scaled.
    """

    spin: float
    is_static: bool
    frequency: Array
    rows: Index
    forces: ComplexArray
    loads: ComplexArray
    weight: Array


def measured_forces(batch: Batch, system: System) -> MeasuredForces:
    """Spring forces by weighted least squares over the channels of each spring.

    Springs without a live channel are left out, and so are the motions that accelerometers measure.
    """
    gains = channel_gains(system.equations.paths, batch.frequency)[batch.lines.index]
    weight = batch.lines.channel_precision
    springs, rows = np.array(system.springs_of_channels), _measured_springs(system, weight, gains)
    selection = (springs[:, None] == rows).astype(float)
    numerator = (weight * gains.conj() * batch.lines.channels) @ selection
    denominator = (weight * np.abs(gains) ** 2) @ selection
    is_measured = denominator > 0
    forces = np.where(is_measured, numerator / np.where(is_measured, denominator, 1.0), 0.0)
    loads = np.zeros((len(forces), 6), complex)
    np.put_along_axis(loads, batch.lines.components, batch.lines.loads, axis=1)
    frequency = batch.line_frequency
    row_weight = _row_weight(system, frequency, loads, len(rows))
    return MeasuredForces(batch.spin, batch.is_static, frequency, rows, forces, loads, row_weight)


def _measured_springs(system: System, weight: Array, gains: ComplexArray) -> Index:
    """Springs that read a force, and that a channel measures at some line: `weight` and `gains` are (K, c)."""
    motions = {item.spring for item in system.equations.point_motions}
    is_live = np.any((weight > 0) & (gains != 0), axis=0)
    springs = {path.spring for path, live in zip(system.equations.paths, is_live, strict=True) if live}
    return np.array(sorted(springs - motions), np.intp)


def determines_motion(system: System, measured: MeasuredForces) -> bool:
    """Whether the measured forces determine every motion of the balance."""
    return has_independent_columns(system.readings.value[measured.rows])


def equation_error(system: System, measured: MeasuredForces) -> tuple[ComplexArray, ComplexArray]:
    """Errors (K, n + r) and derivatives (K, n + r, p): A q - F u, and the forces that no motion explains.

    Each is multiplied by the fixed weight of the measurement.
    """
    R = system.readings[measured.rows]
    inverse = (R.T @ R).inverse() @ R.T
    q = measured.forces @ inverse.value.T
    dq = multiply_derivatives(inverse.derivative, measured.forces)
    A = dynamic_stiffness(system.pencil, measured.frequency, measured.spin)
    driven = (system.equations, measured.frequency, measured.loads, measured.is_static)
    loads = loads_without_reaction(*driven)
    balance = np.matmul(A, q[:, :, None])[:, :, 0] - loads @ system.inputs.value.T
    derivatives = np.matmul(A, dq) + _pencil_derivatives_times(system, measured, q)
    derivatives -= multiply_derivatives(system.inputs.derivative, loads)
    own, of_loads = loads_without_reaction_derivatives(*driven)
    derivatives[:, :, own] -= np.matmul(system.inputs.value, of_loads)
    redundancy = measured.forces - q @ R.value.T
    d_redundancy = -multiply_derivatives(R.derivative, q) - np.matmul(R.value, dq)
    error = np.concatenate([balance, redundancy], axis=1) * measured.weight
    error_derivatives = np.concatenate([derivatives, d_redundancy], axis=1) * measured.weight[:, :, None]
    return np.asarray(error, complex), np.asarray(error_derivatives, complex)


def _pencil_derivatives_times(system: System, measured: MeasuredForces, q: ComplexArray) -> ComplexArray:
    """The derivatives of A times q (K, n, p)."""
    pencil, w = system.pencil, 2 * np.pi * measured.frequency[:, None]
    damping = pencil.damping_derivative(measured.spin)
    stiffness, viscous = multiply_derivatives(pencil.stiffness.derivative, q), multiply_derivatives(damping, 1j * w * q)
    return stiffness + viscous - multiply_derivatives(pencil.mass.derivative, w**2 * q)


def _row_weight(system: System, frequency: Array, loads: ComplexArray, forces: int) -> Array:
    """Weights (K, n + r): the inverse of the load of the line times the arm of each coordinate.

    Runs of all levels and components then have equal weight. The size grows as k + w^2 m; otherwise the highest
    frequencies, where inertia dominates, would decide alone.
    """
    arms = np.maximum(np.abs(system.inputs.value).max(axis=1), MIN_ARM)
    level = np.sqrt(np.sum(np.abs(loads) ** 2, axis=1))[:, None]
    # A line without load has no scale and gets no weight.
    level = np.where(level > 0, level, np.inf)
    ratio = np.diag(system.pencil.mass.value) / np.diag(system.pencil.stiffness.value)
    growth = 1.0 + (2 * np.pi * frequency[:, None]) ** 2 * ratio
    redundancy = np.repeat(level, forces, axis=1)
    return np.asarray(1.0 / np.concatenate([level * arms * growth, redundancy], axis=1))


def fit_equation_error(
    parameters: ParameterSet, batches: Sequence[Batch], system: Callable[..., System], band: tuple[float, float]
) -> Minimum | None:
    """Fit the equation error with the priors, from the declared values; its noise is estimated from its residual.

    Lines outside `band` [Hz] are left out. Returns None where the measured forces do not determine the motion.
    """
    start = parameters.value
    stride = 1 + sum(len(batch.lines.index) for batch in batches) // MAX_REGRESSION_LINES
    declared = system(start)
    data = [_select_band(measured_forces(batch, declared), band, stride) for batch in batches]

    def error(theta: Array) -> float:
        at = system(theta, derivatives=False)
        return float(sum(np.sum(np.abs(equation_error(at, item)[0]) ** 2) for item in data))

    if not all(determines_motion(declared, item) for item in data):
        return None
    count = 2 * sum(item.forces.size for item in data)
    minimum = None
    for _ in range(VARIANCE_ROUNDS):
        variance = 2.0 * error(start) / max(count, 1)
        minimum = minimize(
            parameters,
            start,
            lambda theta, v=variance: _curvature(system(theta), data, v),  # type: ignore[misc]
            lambda theta, v=variance: 2.0 * error(theta) / v,  # type: ignore[misc]
            iterations=15,
            tolerance=1e-5 * count,
        )
        start = minimum.theta
    assert minimum is not None
    return minimum


def _select_band(measured: MeasuredForces, band: tuple[float, float], stride: int) -> MeasuredForces:
    keep = (measured.frequency >= band[0]) & (measured.frequency <= band[1])
    keep &= np.arange(len(keep)) % stride == 0
    return replace(
        measured,
        frequency=measured.frequency[keep],
        forces=measured.forces[keep],
        loads=measured.loads[keep],
        weight=measured.weight[keep],
    )


def _curvature(system: System, data: Sequence[MeasuredForces], variance: float) -> Curvature:
    p = system.parameters
    total = Curvature(0.0, np.zeros(p), np.zeros((p, p)))
    for measured in data:
        error, derivatives = equation_error(system, measured)
        gradient = real_inner_product(derivatives, error[:, :, None])[:, 0]
        information = real_inner_product(derivatives, derivatives)
        chi2 = 2.0 * float(np.sum(np.abs(error) ** 2)) / variance
        total = total + Curvature(chi2, 2.0 * gradient / variance, 2.0 * information / variance)
    return total
