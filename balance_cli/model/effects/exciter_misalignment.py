"""`exciter-misalignment`: the exciter of one component also applies an unmeasured load in another.

    true load = (I + epsilon e_cross e_excited') measured load

in static, sweep and check runs; wind-on runs have no exciter. Several such effects act on the measured loads, not in
series.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.places import Where, ordered_pairs
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations


def _places(geometry: Geometry) -> tuple[Where, ...]:
    return ordered_pairs(COMPONENTS)


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    unit = {(0, 1): "m", (1, 0): "1/m"}.get((where[0][0] == "M", where[1][0] == "M"), "1")
    description = f"Applied {where[1]} over measured {where[0]}."
    return (EffectParameter("fraction", unit, 0.0, 0.005, description, lower=-1.0, upper=1.0),)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    excited, cross = (COMPONENTS.index(name) for name in where)
    entry = np.zeros((6, 6))
    entry[cross, excited] = 1.0
    return replace(equations, exciter_cross_axis=equations.exciter_cross_axis + values["fraction"] * entry)


EFFECT = Effect(
    name="exciter-misalignment",
    summary="An exciter, or a calibration weight, does not act along its axis or through the hub.",
    validity="A fixed real fraction, the same at every frequency and level.",
    reference="Ewins, Modal Testing: Theory, Practice and Application, 2nd ed., 2000, chapter 3 (attaching shakers).",
    signature="Under one component all channels read as if a fixed fraction of another component acted too, in static "
    "and dynamic runs.",
    separated_by="Reverse the exciter, or check its direction with a level and a plumb line.",
    place="two components: the one excited, then the one that is not measured",
    places=_places,
    parameters=_parameters,
    apply=_apply,
)
