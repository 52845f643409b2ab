"""The true rig for comparison with fits: its parameters, and its response from its own equations of motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.identified_model import IdentifiedModel, identified_system
from balance_cli.model.parameters import ParameterSet
from balance_cli.model.response_jacobian import output_jacobian
from balance_cli.model.system_response import response, solve
from balance_cli.simulation.assembly import equations_of_motion
from balance_cli.simulation.response import force_matrix, input_matrix, state_matrix
from balance_cli.simulation.rig import TrueRig

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

BAND = np.arange(5.0, 150.01, 0.25)


def true_parameters(rig: TrueRig, parameters: ParameterSet) -> Array:
    """The rig's values in the order of `parameters`."""
    cells = [cell.name for cell in rig.geometry.cells]
    values = {f"stiffness.{name}": value for name, value in zip(cells, rig.stiffness, strict=True)}
    for i, meter in enumerate(rig.geometry.shaft_meters):
        for name in ("stiffness", "inertia", "damping_ratio"):
            values[f"{meter.parameter}.{name}"] = getattr(rig, f"torque_{name}")[i]
    values["mass"] = rig.mass
    values |= {f"centre_of_gravity.{axis}": value for axis, value in zip("xyz", rig.cg, strict=True)}
    for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)):
        values[f"inertia.{'xyz'[i]}{'xyz'[j]}"] = rig.inertia[i, j] * (1.0 if i == j else -1.0)
    values |= {f"damping_ratio.{i + 1}": value for i, value in enumerate(rig.damping_ratios)}
    channels = rig.geometry.channel_names
    values |= {f"sensitivity.{name}": value for name, value in zip(channels, rig.sensitivities, strict=True)}
    return np.array([values[name] for name in parameters.names])


def true_response(rig: TrueRig, frequency: Array) -> ComplexArray:
    """T (k, c, 6) [V/N, V/(N m)] of the linear rig from its state-space matrices, C (jw - A)^-1 B."""
    mechanics = equations_of_motion(rig)
    A, B, C = state_matrix(mechanics), input_matrix(mechanics)[:, :6], force_matrix(mechanics)
    s = 2j * np.pi * np.asarray(frequency, float)
    forces = C @ np.linalg.solve(s[:, None, None] * np.eye(len(A)) - A, B.astype(complex))
    cells = [cell.name for cell in rig.geometry.cells]
    volts = []
    for channel, sensitivity in zip(rig.geometry.channels, rig.sensitivities, strict=True):
        meters = [meter.name or True for meter in rig.geometry.shaft_meters]
        row = len(cells) + meters.index(channel.torque_meter) if channel.torque_meter else cells.index(channel.cell)
        gain = np.full(len(s), sensitivity, complex)
        if channel.lowpass is not None:
            gain = gain / (1 + s / (2 * np.pi * channel.lowpass))
        if channel.time_constant is not None:
            gain = gain * s * channel.time_constant / (1 + s * channel.time_constant)
        volts.append(gain[:, None] * forces[:, row])
    return np.stack(volts, axis=1)


def response_errors(rig: TrueRig, model: IdentifiedModel) -> tuple[Array, Array]:
    """Relative error (k, 6) of each component's response over the cells, and its Cramer-Rao prediction."""
    system = identified_system(model)
    solution = solve(system, BAND)
    truth = true_response(rig, BAND)
    free = model.parameters.declared_sigma > 0
    covariance = model.covariance[np.ix_(free, free)]
    fitted = response(system, solution)
    size = np.linalg.norm(truth, axis=1)
    error = np.linalg.norm(fitted - truth, axis=1) / size
    predicted = np.empty_like(error)
    for j in range(6):
        loads = np.zeros((len(BAND), 6), complex)
        loads[:, j] = 1.0
        J = output_jacobian(system, solution, np.arange(len(BAND)), loads)
        variance = np.real(np.einsum("kcp,pq,kcq->k", J, covariance, J.conj(), optimize=True))
        predicted[:, j] = np.sqrt(variance) / size[:, j]
    return error, predicted
