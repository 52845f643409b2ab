"""`structural-damping`: the force of a cell lags its elongation by the same angle at every frequency.

    f = k (1 + j eta + r (2 / pi) eta ln(w / w0)) d        (for positive frequencies; at rest f = k d)

The channels of the cell read the whole force. With a constant stiffness, r = 0, the law is not causal: a spring whose
force lags by one angle at all frequencies must stiffen with frequency, r = 1, or its force precedes the elongation.
Both terms are the real and the imaginary part of k (1 + (2 / pi) eta ln(s / w0)). w0 / (2 pi), the frequency at which k
is the stiffness, is in the middle of the modes of the rig as declared: the geometric mean over its motions, each alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.places import Where, cells_at, each_cell_or_all
from balance_cli.model.effects.search_hints import SearchHints
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import TORQUE, Equations


def _places(geometry: Geometry) -> tuple[Where, ...]:
    """All cells together, then one place per cell and per torque meter."""
    meters = (meter.label(TORQUE) for meter in geometry.shaft_meters)
    return (*each_cell_or_all(geometry), *((name,) for name in meters if name not in geometry.cell_names))


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    return (
        EffectParameter("loss_factor", "1", 0.0, 0.005, "Tangent of the angle by which the force lags.", lower=0.0),
        EffectParameter(
            "causality",
            "1",
            0.0,
            0.1,
            "Fraction of the stiffening with frequency of a causal law; 0 is a constant stiffness.",
            lower=0.0,
            upper=1.0,
            start=1.0,
            nuisance=True,
        ),
    )


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    affected = np.zeros(len(equations.springs))
    affected[[i for i, name in enumerate(equations.springs) if name in where]] = 1.0
    affected[cells_at(geometry, where)] = 1.0
    loss = values["loss_factor"] * affected
    increase = (2.0 / np.pi) * values["causality"] * loss
    return replace(equations, loss=equations.loss + loss, frequency_stiffness=equations.frequency_stiffness + increase)


def _starts(geometry: Geometry, where: Where) -> tuple[Mapping[str, float], ...]:
    """The causal law, and the law with constant stiffness, in which it is usually written."""
    return ({"causality": 1.0}, {"causality": 0.0})


EFFECT = Effect(
    name="structural-damping",
    summary="The cells dissipate a fixed fraction of their energy in each cycle, whatever its frequency.",
    validity="A small loss factor; the stiffening affects the eigenfrequencies to first order.",
    reference="Crandall, The role of damping in vibration theory, J. Sound Vib. 11 (1970) 3-18. Bishop and Johnson, "
    "The Mechanics of Vibration, 1960. Makris, Causal hysteretic element, J. Eng. Mech. 123 (1997) 1209-1214.",
    signature="Damping ratios that no single damping matrix explains, and a phase between two cells under one load "
    "that does not vanish at low frequency.",
    separated_by="The damping at low frequency: a viscous force vanishes there, this one does not.",
    place="a cell, `all` of them, or `torque`, the shaft of the torque meter",
    places=_places,
    parameters=_parameters,
    apply=_apply,
    search=SearchHints(starts=_starts),
)
