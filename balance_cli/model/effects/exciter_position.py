"""`exciter-position`: exciters act at a point beside the hub.

With d the vector from the declared hub to the point, a force F that a force cell records makes at the hub

    load = (F, d x F)

in sweeps and check runs, of one exciter or, where the declared hub is wrong for them, of all.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.geometry_scales import rig_length
from balance_cli.model.effects.places import Where, all_or_each_force
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations

SMALL = 0.005
"""A distance that matters, relative to the size of the rig: a misalignment that matters, as of a direction."""
AXES = ("x", "y", "z")


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    length = rig_length(geometry)
    along = where[0][1:] if where[0] in COMPONENTS else ""
    return tuple(
        EffectParameter(
            axis, "m", 0.0, SMALL * length, f"Distance of the point from the hub along {axis}.", -length, length
        )
        for axis in AXES
        if axis != along
    )


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    forces = [i for i in range(3) if where[0] not in COMPONENTS or COMPONENTS[i] == where[0]]
    matrix = equations.exciter_cross_axis
    for name, distance in values.items():
        added = np.zeros((6, 6))
        for i in forces:
            added[3:, i] = np.cross(np.eye(3)[AXES.index(name)], np.eye(3)[i])
        matrix = matrix + distance * added
    return replace(equations, exciter_cross_axis=matrix)


EFFECT = Effect(
    name="exciter-position",
    summary="An exciter, or all of them, act at a point beside the hub.",
    validity="One point, the same in all sweeps and check runs of the component.",
    reference="Ewins, Modal Testing: Theory, Practice and Application, 2nd ed., 2000, chapter 3 (attaching shakers).",
    signature="In sweeps of a force all channels read as if moments in a fixed proportion to it acted too; at `all` "
    "one distance explains the moments of every force.",
    separated_by="Measure where the stingers meet the hub. One moment alone is an `exciter-misalignment` too.",
    place="a force, or `all`",
    places=all_or_each_force,
    parameters=_parameters,
    apply=_apply,
)
