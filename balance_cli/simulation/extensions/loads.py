"""Effects in the exciters: loads that their force cells do not measure, and errors of their readings."""

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
    """The exciter of the first component also applies a `fraction` of its load in the second, which is not measured."""

    name: ClassVar[str] = "exciter-misalignment"
    fraction: float = 0.0

    def true_loads(self, loads: Array, kind: str) -> Array:
        """The loads with the unmeasured part."""
        if kind not in KINDS_WITH_EXCITERS:
            return loads
        excited, cross = self.pair(COMPONENTS)
        loads = loads.copy()
        loads[:, cross] += self.fraction * loads[:, excited]
        return loads


@dataclass(frozen=True)
class LoadOffset(Extension):
    """The exciter's force cell has an `offset` [N, N m]."""

    name: ClassVar[str] = "load-offset"
    offset: float = 0.0

    def recorded_loads(self, loads: Array, kind: str) -> Array:
        """The readings with the offset."""
        shifted = loads.copy()
        shifted[:, self.places(COMPONENTS)] += self.offset
        return shifted
