"""Hub loads from constant readings by equilibrium, which needs sensitivities, positions and axes, but no stiffness."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS, FREEDOMS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.kinematics import elongation_matrix
from balance_cli.campaign.rig.load_components import COMPONENT_OF_FREEDOM

Array = NDArray[np.float64]

LARGEST_REST = 1e-6
"""Of a load through the cells: what the channels may leave of it by rounding where they read all of its cells."""


@dataclass(frozen=True)
class Equilibrium:
    """Loads (n, k) of `components` from readings (n, c) of `channels`: readings @ `loads_per_reading` (c, k)."""

    channels: tuple[str, ...]
    components: tuple[str, ...]
    loads_per_reading: Array


def equilibrium(geometry: Geometry, channel_names: Sequence[str]) -> Equilibrium:
    """Return the hub loads that the cells balance and these channels read [N/V, N m/V].

    Forces of the cells add up to the load whatever their stiffness is. A moment that goes through a torque meter is no
    load of the cells; a load of which a cell has a part that no channel reads is left out.
    """
    usable = [item for item in geometry.channels if item.name in channel_names and item.cell_weights]
    usable = [item for item in usable if item.measures_dc]
    names = tuple(item.name for item in usable)
    if not usable:
        return Equilibrium((), (), np.zeros((0, 0)))
    readings = np.array([[item.cell_weights.get(name, 0.0) for name in geometry.cell_names] for item in usable])
    size = np.linalg.norm(readings, axis=1, keepdims=True)
    order = [COMPONENTS.index(COMPONENT_OF_FREEDOM[name]) for name in FREEDOMS]
    forces = np.empty((len(geometry.cells), len(COMPONENTS)))
    forces[:, order] = elongation_matrix(geometry, np.asarray(geometry.hub, float))
    per_unit = np.linalg.pinv(readings / size).T @ forces
    rest = np.linalg.norm((readings / size).T @ per_unit - forces, axis=0)
    carried = np.linalg.norm(forces, axis=0)
    known = (carried > 0.0) & (rest <= LARGEST_REST * carried)
    known &= ~np.isin(COMPONENTS, [meter.component for meter in geometry.shaft_meters])
    sensitivity = np.array([item.sensitivity for item in usable])[:, None]
    components = tuple(name for name, is_known in zip(COMPONENTS, known, strict=True) if is_known)
    return Equilibrium(names, components, per_unit[:, known] / (size * sensitivity))
