"""What no channel shows: how far a mass that moves in a run, and did not in the sweeps, changes the loads.

A mass m on the metric side adds the force w^2 m times its motion x, which is in proportion to the loads: the readings
are T (f + w^2 m N' N x) where the part is rigid, N the motion of the place per unit of that of the hub. That is the
reading of other loads, so that the residual test stays silent however redundant the channels are. A flexible mast or
support between the mass and the hub makes other readings, as far as the model has it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.model.balance import balance_model
from balance_cli.model.system import System
from balance_cli.model.system_response import readings_of_inputs, response, solve
from balance_cli.reduction.harmonic_loads import LoadProblem
from balance_cli.reduction.reliability import MASS_SHARE, UndeclaredMass, unnoticed_changes
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.reduction.rotor_record import RotorRecord
from balance_cli.reduction.weighted_least_squares import SolvedLoads

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def undeclared_mass(
    record: RotorRecord, geometry: Geometry, source: ResponseSource, problem: LoadProblem, solved: SolvedLoads
) -> UndeclaredMass | None:
    """Return how far an undeclared mass changes the loads of a record; None where the masses are not declared.

    A response without equations of motion has the motion of the declared rig.
    """
    system = source.system or _declared_system(geometry)
    if system is None:
        return None
    frequency, total = record.spectra.frequency_hz[1:], sum(body.mass for body in geometry.bodies)
    columns = [COMPONENTS.index(name) for name in record.components]
    loads = np.zeros((len(frequency), len(COMPONENTS)), complex)
    loads[:, columns] = solved.loads
    readings = _readings_of_masses(system, geometry, frequency, record.spin, loads) * total
    if source.system is not None:
        rows = source.channel_combination(frequency, record.health.live).rows
        readings = readings[:, :, rows]
    else:
        T = response(system, solve(system, frequency, record.spin))[:, :, columns]
        readings = _as_loads(T, readings) @ problem.T.swapaxes(1, 2)
    error = np.concatenate([readings.real, readings.imag], axis=2)
    size = unnoticed_changes(solved.equations, error, solved.degrees, solved.limit, MASS_SHARE)
    worst = np.argmax(size, axis=1)
    places = ("the hub", *(body.name for body in geometry.bodies))
    return UndeclaredMass(MASS_SHARE * total, places, worst, np.take_along_axis(size, worst[:, None, :], axis=1)[:, 0])


def join_harmonics_of_masses(parts: Sequence[UndeclaredMass | None]) -> UndeclaredMass | None:
    """Return the first harmonic of each part, one below the other; None where a part has none."""
    known = [part for part in parts if part is not None]
    if len(known) < len(parts) or not known:
        return None
    place, change = (np.concatenate([getattr(part, name)[:1] for part in known]) for name in ("place", "change"))
    return UndeclaredMass(known[0].mass, known[0].places, place, change)


def _declared_system(geometry: Geometry) -> System | None:
    """Return the declared rig; None where masses, stiffness or damping are not declared."""
    try:
        return balance_model(geometry).system(derivatives=False)
    except (UserError, np.linalg.LinAlgError):
        return None


def _readings_of_masses(
    system: System, geometry: Geometry, frequency: Array, spin: float, loads: ComplexArray
) -> ComplexArray:
    """Return the volts (h, p, c) that 1 kg adds at each of p places, under loads (h, 6): the hub, and each body."""
    solution = solve(system, frequency, spin)
    x = (solution.receptance @ system.inputs.value @ loads[:, :, None])[:, :, 0]
    equations = system.equations
    at_bodies = [equations.motion(np.asarray(body.position, float)).value for body in geometry.bodies]
    N = np.array([equations.inputs.value[:, :3].T, *at_bodies])
    force = (2.0 * np.pi * frequency[:, None, None]) ** 2 * np.einsum("pin,pij,hj->hpn", N, N, x, optimize=True)
    return readings_of_inputs(system, solution, force)


def _as_loads(T: ComplexArray, readings: ComplexArray) -> ComplexArray:
    """Return the loads (h, p, m) that give readings (h, p, c) by the response T (h, c, m), which rigid parts permit."""
    size = np.maximum(np.linalg.norm(T, axis=2), np.finfo(float).tiny)[:, :, None]
    inverse = np.linalg.pinv(T / size)
    return np.asarray((readings / size.swapaxes(1, 2)) @ inverse.swapaxes(1, 2))
