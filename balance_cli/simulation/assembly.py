"""The equations of motion of a true rig: rigid plate, shaft, and extensions in the order in which they act."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS, FREEDOMS
from balance_cli.io.errors import UserError
from balance_cli.simulation.mechanics import (
    ROTATION_ROWS,
    Mechanics,
    body_mass,
    displacement_rows,
    modal_damping,
)
from balance_cli.simulation.rig import TrueRig

Array = NDArray[np.float64]


def free_motions(rig: TrueRig) -> list[int]:
    """Indices of the degrees of freedom among x y z psi theta phi."""
    return [FREEDOMS.index(name) for name in FREEDOMS if name in rig.geometry.freedom]


def rigid_plate(rig: TrueRig) -> Mechanics:
    """The rigid plate on its cells and the shafts of its torque meters, without any extension.

    A moment with a torque meter about its axis acts on the shaft; the others load the plate.
    """
    geometry = rig.geometry
    free = free_motions(rig)
    mass = body_mass(rig.mass, rig.inertia)[np.ix_(free, free)]
    cells = [c.direction @ displacement_rows(np.subtract(c.position, rig.cg)) for c in geometry.cells]
    rows = np.array(cells)[:, free]
    stiffness = rows.T @ (rig.stiffness[:, None] * rows)
    damping = modal_damping(mass, stiffness, rig.damping_ratios)
    at_hub = np.vstack([displacement_rows(np.subtract(geometry.hub, rig.cg)), ROTATION_ROWS])
    loads = at_hub[:, free].T
    for meter in geometry.shaft_meters:
        loads[:, COMPONENTS.index(meter.component)] = 0.0
    n = len(free)
    plate = Mechanics(
        names=tuple(FREEDOMS[i] for i in free),
        mass=mass,
        damping=damping,
        stiffness=np.zeros((n, n)),
        loads=loads,
        cell_rows=rows,
        cell_stiffness=rig.stiffness,
        torque_rows=np.zeros((0, n)),
        plate=np.eye(6)[:, free],
        carried=np.eye(6)[:, free],
        non_metric_motion=np.zeros((6, n)),
        cg=rig.cg,
        plate_damping=lambda changed_mass: modal_damping(changed_mass, stiffness, rig.damping_ratios),
    )
    for axis in "xyz":
        plate = _with_shaft(plate, rig, [i for i, meter in enumerate(geometry.shaft_meters) if meter.axis == axis])
    order = np.argsort([i for axis in "xyz" for i, m in enumerate(geometry.shaft_meters) if m.axis == axis])
    return replace(plate, torque_rows=plate.torque_rows[order.astype(int)])


def _with_shaft(plate: Mechanics, rig: TrueRig, members: list[int]) -> Mechanics:
    """The plate with a shaft of these torque meters, from the hub to its end on the ground or on the plate.

    Each meter is a spring and a dashpot between what turns on its two sides: of a single one beside the plate
    `J phi'' + d phi' + k phi = M`. What turns behind the last one is at rest, or the plate.
    """
    if not members:
        return plate
    last = rig.geometry.shaft_meters[members[-1]]
    first = plate.size
    with_shaft = plate.with_coordinates(tuple(f"twist {i}" for i in members))
    with_shaft.loads[first, COMPONENTS.index(last.component)] = 1.0
    turning = [np.eye(with_shaft.size)[first + i] for i in range(len(members))]
    rotation = ROTATION_ROWS["xyz".index(last.axis)] * float(last.carried_by == "plate")
    with_shaft.carried[:, first:] = rotation[:, None]
    end = rotation @ with_shaft.plate
    rows = []
    for place, (i, behind) in enumerate(zip(members, (*turning[1:], end), strict=True)):
        twist = turning[place] - behind
        k, j = rig.torque_stiffness[i], rig.torque_inertia[i]
        with_shaft.mass[first + place, first + place] = j
        with_shaft.damping[:] += 2 * rig.torque_damping_ratio[i] * np.sqrt(k * j) * np.outer(twist, twist)
        with_shaft.stiffness[:] += k * np.outer(twist, twist)
        rows.append(k * twist)
    return replace(with_shaft, torque_rows=np.vstack([with_shaft.torque_rows, *rows]))


def equations_of_motion(rig: TrueRig, rotor_speed: float = 0.0, attached: Collection[str] = ()) -> Mechanics:
    """The rig with all its extensions, at `rotor_speed` [Hz], the exciters of these components `attached` to its hub.

    Raises UserError where it is not restrained, or its inertia is not positive.
    """
    mechanics = rigid_plate(rig)
    for extension in rig.extensions:
        mechanics = extension.mechanics(mechanics, rig.geometry, rotor_speed)
    for extension in rig.extensions:
        mechanics = extension.exciter_mechanics(mechanics, attached)
    if np.linalg.eigvalsh(mechanics.mass)[0] <= 0:
        names = ", ".join(f"`{extension.name}`" for extension in rig.extensions) or "the bodies"
        fault = f"these parameters are not physical: the inertia with {names} is not positive"
        raise UserError(fault, place="effects", remedy="Check the masses of the effects")
    if not np.all(np.linalg.eigvalsh(mechanics.total_stiffness()) > 0):
        raise UserError(
            "the cells do not hold every degree of freedom", place="cells", remedy="Add cells or reduce `freedom`"
        )
    return replace(mechanics, accelerometer_rows=_accelerometer_rows(mechanics, rig))


def _accelerometer_rows(mechanics: Mechanics, rig: TrueRig) -> Array:
    """Motion (a, n) along the axis of each accelerometer, of the side on which it stands."""
    sensors = [channel.accelerometer for channel in rig.geometry.channels if channel.accelerometer is not None]
    moving = {"metric": mechanics.plate_displacement, "non-metric": mechanics.non_metric_displacement}
    rows = [sensor.direction @ moving[sensor.side](sensor.position) for sensor in sensors]
    return np.array(rows).reshape(-1, mechanics.size)
