"""`exciter-misalignment`: the exciter of one component also applies an unmeasured load in another.

    true load = (I + epsilon e_cross e_excited') measured load

in sweeps and check runs. Wind-on runs have no exciter, and in static runs weights hang straight whatever the exciter
does (see `weight-misalignment`). Several such effects act on the measured loads, not in series.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.geometry_scales import rig_length
from balance_cli.model.effects.places import Where, ordered_pairs
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations

Array = NDArray[np.float64]


def pairs_of_components(geometry: Geometry) -> tuple[Where, ...]:
    """One place for each ordered pair of load components."""
    return ordered_pairs(COMPONENTS)


def cross_axis_parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    """The fraction of the load in the first component of a place that acts in the second."""
    length = rig_length(geometry)
    to_moment = (where[1][0] == "M") - (where[0][0] == "M")
    unit, size = {0: ("1", 1.0), 1: ("m", length), -1: ("1/m", 1.0 / length)}[to_moment]
    description = f"Applied {where[1]} over measured {where[0]}."
    return (EffectParameter("fraction", unit, 0.0, 0.005 * size, description, lower=-size, upper=size),)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    added = values["fraction"] * cross_axis_entry(where)
    return replace(equations, exciter_cross_axis=equations.exciter_cross_axis + added)


def cross_axis_entry(where: Where) -> Array:
    """The matrix (6, 6) with a one that makes the first component of a place act in the second."""
    applied, cross = (COMPONENTS.index(name) for name in where)
    entry = np.zeros((6, 6))
    entry[cross, applied] = 1.0
    return entry


EFFECT = Effect(
    name="exciter-misalignment",
    summary="An exciter does not act along its axis or through the hub.",
    validity="A fixed real fraction, the same at every frequency and level, in all sweeps and check runs: one set-up.",
    reference="Ewins, Modal Testing: Theory, Practice and Application, 2nd ed., 2000, chapter 3 (attaching shakers).",
    signature="In sweeps of one component all channels read as if a fixed fraction of another component acted too; "
    "static runs do not.",
    separated_by="Reverse the exciter, or check its direction with a level and a plumb line. Static runs under weights "
    "show whether the rig itself couples the components.",
    place="two components: the one excited, then the one that is not measured",
    places=pairs_of_components,
    parameters=cross_axis_parameters,
    apply=_apply,
)
