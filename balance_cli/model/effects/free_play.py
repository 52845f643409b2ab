"""`free-play`: a part with clearance touches the plate beside a cell once it has moved far enough.

Two stops at equal distances g, each a spring k while it is in contact, d being the cell's elongation:

    f = k (d - g) for d > g,        f = k (d + g) for d < -g,        f = 0 between

The cell's channels do not read f.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.places import Where, cell_at, each_measured_cell
from balance_cli.model.effects.search_hints import SearchHints, Start
from balance_cli.model.mechanics.cell_force import CellForce, CellMotion
from balance_cli.model.mechanics.dual_numbers import Dual, stack
from balance_cli.model.mechanics.equations import Equations

RELEVANT_STIFFNESS = 1e-3
"""Stiffness of a stop that matters, relative to that of the cell."""
GAPS = (1e-3, 3e-3, 1e-2, 3e-2, 1e-1, 2.5e-1)
"""Gaps at which a search scores the stops, relative to the cell's elongation at full range. Beyond the largest motion
of the records the stops do nothing; within a factor 1.7 of the true gap most of the force is explained."""


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    cell = cell_at(geometry, where)
    k, gap = cell.effective_stiffness, GAPS[2] * cell.full_range / cell.effective_stiffness
    return (
        EffectParameter("stiffness", "N/m", 0.0, RELEVANT_STIFFNESS * k, "Stiffness of each stop.", lower=0.0),
        EffectParameter("gap", "m", gap, 0.1 * gap, "Clearance to each stop.", lower=0.0, start=gap, nuisance=True),
    )


def _extra_starts(geometry: Geometry, where: Where) -> tuple[Start, ...]:
    cell = cell_at(geometry, where)
    return tuple({"gap": share * cell.full_range / cell.effective_stiffness} for share in GAPS)


def _start_from_score(geometry: Geometry, where: Where, start: Start, estimate: Start) -> Start:
    """The stiffness that the score estimates, with the gap of the score."""
    return {"stiffness": estimate["stiffness"], "gap": start["gap"]} if "gap" in start else dict(estimate)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    spring = equations.springs.index(where[0])
    force = CellForce(spring, stack([values["stiffness"], values["gap"]]), _beyond_gap, read=False, has_kinks=True)
    return equations.with_force(force)


def _beyond_gap(motion: CellMotion, values: Dual) -> Dual:
    """By how much the elongation exceeds the gap (n,)."""
    d = motion.elongation
    side = np.sign(d.value) * (np.abs(d.value) > values.value[1])
    beyond: Dual = d * np.abs(side) - values[1] * side
    return beyond


EFFECT = Effect(
    name="free-play",
    summary="A part with clearance touches beside a cell where the motion is large.",
    validity="Equal clearance and stiffness on both sides; no friction, no impact that rings.",
    reference="Shaw and Holmes, A periodically forced piecewise linear oscillator, J. Sound Vib. 90 (1983) 129.",
    signature="Below a level of motion nothing is wrong; above it a cell seems stiffer, and distortion of all odd "
    "orders appears.",
    separated_by="Sweeps at several levels: a cubic spring shows at every level, stops only above one.",
    place="a cell",
    places=each_measured_cell,
    parameters=_parameters,
    apply=_apply,
    needs_mean=True,
    search=SearchHints(extra_starts=_extra_starts, start_from_score=_start_from_score),
)
