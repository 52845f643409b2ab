"""`weight-misalignment`: the loads of a static calibration also act in a component in which none is recorded.

    true load = (I + epsilon e_cross e_applied') recorded load

in static runs alone. A cable that runs over a pulley out of line, or a hook beside the hub, does this, whatever
the exciters do (`exciter-misalignment`). Several such effects act on the recorded loads, not in series.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect
from balance_cli.model.effects.exciter_misalignment import (
    cross_axis_entry,
    cross_axis_parameters,
    pairs_of_components,
)
from balance_cli.model.effects.places import Where
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    added = values["fraction"] * cross_axis_entry(where)
    return replace(equations, weight_cross_axis=equations.weight_cross_axis + added)


EFFECT = Effect(
    name="weight-misalignment",
    summary="A calibration weight does not pull along its axis or through the hub.",
    validity="A fixed real fraction, the same in all static runs.",
    reference="AIAA R-091A-2020, Calibration and Use of Internal Strain-Gage Balances (alignment of applied loads).",
    signature="In static runs all channels read as if a fixed fraction of another component acted too; sweeps do not.",
    separated_by="Check cables and hooks with a level and a plumb line, or apply the load from the other side.",
    place="two components: the one applied, then the one that is not recorded",
    places=pairs_of_components,
    parameters=cross_axis_parameters,
    apply=_apply,
)
