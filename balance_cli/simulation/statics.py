"""Static calibration: loads applied step by step, each held until the rig is at rest."""

from __future__ import annotations

from collections.abc import Mapping
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.simulation.mechanics import Mechanics
from balance_cli.simulation.nonlinear import NonlinearForces, solve_rest_state
from balance_cli.simulation.plans import Component, StaticPlan
from balance_cli.simulation.response import forces_read_by_channels, full_system

Array = NDArray[np.float64]


def load_row(loads: Mapping[Component, float]) -> Array:
    """Loads by name as a row (6,)."""
    return np.array([loads.get(name, 0.0) for name in get_args(Component)])


def static_load_points(plan: StaticPlan) -> Array:
    """Load points (rows, 6) in order: the trim, then each component up, down through it, and back; or those listed."""
    if plan.points is not None:
        listed = np.vstack([np.zeros((1, len(COMPONENTS))), *(load_row(point) for point in plan.points)])
        return np.asarray(listed + load_row(plan.trim_loads))
    up = np.arange(1, plan.steps + 1)
    ladder = np.concatenate([up, up[-2::-1], [0], -up, -up[-2::-1], [0]]) / plan.steps
    blocks: list[Array] = [np.outer(ladder, load_row({name: largest})) for name, largest in plan.largest.items()]
    changes: Array = np.vstack([np.zeros((1, len(COMPONENTS))), *blocks])
    points: Array = changes + load_row(plan.trim_loads)
    return points


def static_forces(mechanics: Mechanics, loads: Array) -> Array:
    """Cell forces, torques and accelerations (rows, c+t+a) at rest under `loads` (rows, 6), applied in this order."""
    gain = full_system(mechanics).static_gain()
    cells = mechanics.sensors
    if not mechanics.forces:
        return np.asarray(loads @ gain.T)
    forces, flexibility = NonlinearForces.from_cell_forces(mechanics.forces), gain[cells:][: len(mechanics.forces)]
    extra = solve_rest_state(forces, flexibility, loads).force
    read: Array = np.hstack([loads, extra]) @ gain[:cells].T + forces_read_by_channels(mechanics, extra)
    return read
