"""`structural-damping`: a cell's force lags its elongation by the same angle at every frequency.

    f = k (1 + j eta) d        (for positive frequencies; at rest f = k d)

The channels of the cell read the whole force. A law of this kind cannot be causal with a constant k: over a factor e of
frequency a real spring stiffens by (2 / pi) eta, which is left out here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from balance_cli.effects.base import Effect, EffectParameter, Where, cells_at, each_cell_or_all
from balance_cli.equations import Equations
from balance_cli.geometry import Geometry
from balance_cli.jets import Jet


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    return (
        EffectParameter("loss_factor", "1", 0.0, 0.005, "Tangent of the angle by which the force lags.", lower=0.0),
    )


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Jet]) -> Equations:
    chosen = np.zeros(len(equations.springs))
    chosen[cells_at(geometry, where)] = 1.0
    return replace(equations, loss=equations.loss + values["loss_factor"] * chosen)


EFFECT = Effect(
    name="structural-damping",
    summary="The cells lose a fixed share of their energy in each cycle, whatever its frequency.",
    validity="A small loss factor, and a band over which k does not change much: (2 / pi) eta for a factor e.",
    reference="Crandall, The role of damping in vibration theory, J. Sound Vib. 11 (1970) 3-18. Bishop and Johnson, "
    "The Mechanics of Vibration, 1960.",
    trace="Damping ratios that do not follow from one damping matrix, and a phase between two cells under one load "
    "that does not vanish at low frequency.",
    separated_by="Damping at low frequency: a viscous force vanishes there, this one does not.",
    place="a cell, or `all`",
    places=each_cell_or_all,
    parameters=_parameters,
    apply=_apply,
)
