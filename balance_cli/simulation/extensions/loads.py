"""Effects in the exciters: what acts besides what their force cells feel, and what these read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.simulation.extensions.base import Extension

Array = NDArray[np.float64]

KINDS_WITH_EXCITERS = ("static", "sweep", "check")
"""Kinds of run in which exciters apply the loads."""


@dataclass(frozen=True)
class ExciterMisalignment(Extension):
    """The exciter of the first component spills a `fraction` of its load into the second, which nobody measures."""

    name: ClassVar[str] = "exciter-misalignment"
    fraction: float = 0.0

    def true_loads(self, loads: Array, kind: str) -> Array:
        """With the spilt part."""
        if kind not in KINDS_WITH_EXCITERS:
            return loads
        excited, spilt = self.pair(COMPONENTS)
        loads = loads.copy()
        loads[:, spilt] += self.fraction * loads[:, excited]
        return loads


@dataclass(frozen=True)
class LoadOffset(Extension):
    """The exciter's force cell reads `offset` [N, N m] too much."""

    name: ClassVar[str] = "load-offset"
    offset: float = 0.0

    def recorded_loads(self, loads: Array, kind: str) -> Array:
        """Shifted."""
        shifted = loads.copy()
        shifted[:, self.places(COMPONENTS)] += self.offset
        return shifted
