"""`gravity-stiffness`: the weight of the metric side stands above the cells that carry it, and a tilt lets it sink.

The weight W has its center of gravity at a height h above the points where the cells carry it, on average by their
shares. Where the plate tilts by the small angles theta and phi, the center of gravity sinks relative to those points
by h (theta^2 + phi^2)/2, so that with T the tilts per coordinate and the one parameter k = W h

    K -> K - k T' T

and the cells resist the moment k theta beside the load. A metric side that hangs below its cells has a negative k.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.rig_scales import stiffness_by_motion
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.places import Where
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations

TILTS = ("theta", "phi")

SMALL = 1e-3
"""A stiffness that matters, relative to that of the cells: gh/(i w)^2 of a rig with h = i = 0.3 m at 29 Hz."""

LARGEST = 0.25
"""Bound, relative to the tilt stiffness of the cells: a rig of which gravity takes more is about to fall over."""


def _places(geometry: Geometry) -> tuple[Where, ...]:
    """The whole rig, if it can tilt."""
    return ((),) if set(TILTS) & set(geometry.freedom) else ()


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    cells = [stiffness_by_motion(geometry)[tilt] for tilt in TILTS if tilt in geometry.freedom]
    description = "Weight times the height of its center of gravity above the points of support; negative if it hangs."
    bounds = (-LARGEST * max(cells), LARGEST * min(cells))
    return (EffectParameter("stiffness", "N m/rad", 0.0, SMALL * max(cells), description, *bounds),)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    tilts = np.diag([float(name in TILTS) for name in equations.coordinates])
    return replace(equations, extra_stiffness=equations.extra_stiffness - values["stiffness"] * tilts)


EFFECT = Effect(
    name="gravity-stiffness",
    summary="The weight of the metric side stands above its cells (or hangs below them) and sinks (rises) as it tilts.",
    validity="Gravity along z, small tilts, rigid ground; the force of a cell follows its point on the plate and keeps "
    "its direction. A two-force strut under load turns with the plate as well (transverse-stiffness).",
    reference="Den Hartog, Mechanical Vibrations, 4th ed., 1956, chapter 2 (inverted pendulum on springs).",
    signature="At rest the cells read a fixed fraction more than the applied moments Mx and My, forces at a distance "
    "included; the tilt modes are lower, and those of translation are not.",
    separated_by="Sweeps or statics with a known mass removed or added above the cells.",
    place="none",
    places=_places,
    parameters=_parameters,
    apply=_apply,
)
