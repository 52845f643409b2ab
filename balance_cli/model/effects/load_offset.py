"""`load-offset`: a constant is added to the force cell of an exciter whenever it applies a load.

    true load = exciter cross-axis matrix (recorded load - offset)

A component that was not applied in a run, or in a static row, is declared zero and has no offset.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.geometry_scales import load_range
from balance_cli.model.effects.places import Where, each_component
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations

SMALL = 2e-4
"""An offset that matters, relative to what the largest cell can carry: the zero of a good force cell."""


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    unit = "N" if where[0].startswith("F") else "N m"
    scale = SMALL * load_range(geometry, where[0])
    return (EffectParameter("offset", unit, 0.0, scale, "Recorded load without an applied load."),)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    unit = np.array([float(name == where[0]) for name in COMPONENTS])
    return replace(equations, load_offset=equations.load_offset + values["offset"] * unit)


EFFECT = Effect(
    name="load-offset",
    summary="The force cell of an exciter does not read zero without load.",
    validity="The same offset in all runs in which the component is applied.",
    reference="Wigren and Schoukens, Three free data sets for development and benchmarking in nonlinear system "
    "identification, ECC 2013 (offset of the Silverbox's input).",
    signature="The means of all strain channels shift in the proportions of the load itself; a static run has a step "
    "where the load is first applied.",
    separated_by="A record with the exciter attached and at rest. The offset of a channel appears in that channel "
    "alone.",
    place="a load component",
    places=each_component,
    parameters=_parameters,
    apply=_apply,
    needs_mean=True,
)
