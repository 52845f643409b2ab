"""`asymmetric-damping`: viscous friction beside a cell differs between the two directions of motion.

With d' the rate of the cell's elongation and D the difference c+ - c- of the two dampings,

    f = D / 2 |d'|,        c+ = c + D / 2 for d' > 0,        c- = c - D / 2 for d' < 0

The mean c of the two is linear damping: that of the modes, or a dashpot. The cell's channels do not read f.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.rig_scales import rig_frequency
from balance_cli.model.effects.base import Effect, EffectParameter
from balance_cli.model.effects.places import Where, cell_at, each_measured_cell
from balance_cli.model.effects.search_hints import SearchHints
from balance_cli.model.mechanics.cell_force import CellForce, CellMotion
from balance_cli.model.mechanics.dual_numbers import Dual, stack
from balance_cli.model.mechanics.equations import Equations

SMALL = 0.004
"""Difference over stiffness of the cell that matters, in periods of the rig's modes: a loss factor of 2.5 % there."""


def _parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    cell = cell_at(geometry, where)
    scale = SMALL / rig_frequency(geometry) * cell.effective_stiffness
    return (EffectParameter("difference", "N s/m", 0.0, scale, "Damping of positive minus that of negative rates."),)


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    spring, difference = equations.springs.index(where[0]), stack([values["difference"]])
    return equations.with_force(CellForce(spring, difference, _half_size, read=False, has_kinks=True, needs_rate=True))


def _half_size(motion: CellMotion, values: Dual) -> Dual:
    return motion.rate * (0.5 * np.sign(motion.rate.value))


EFFECT = Effect(
    name="asymmetric-damping",
    summary="Viscous friction beside a cell (a seal with a lip, a screw, a damper with a valve) depends on the "
    "direction of motion.",
    validity="Force in proportion to speed in each direction; no memory.",
    reference="Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30 (1994) 1083, section 2.",
    signature="The mean of each channel moves with the level of vibration, in the proportions of a force along the "
    "cell; distortion of even orders appears.",
    separated_by="Records at two levels: an offset of a load or a channel is the same at both. A quadratic spring "
    "bends static curves, too.",
    place="a cell",
    places=each_measured_cell,
    parameters=_parameters,
    apply=_apply,
    needs_mean=True,
    search=SearchHints(on_request=True),
)
