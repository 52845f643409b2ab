"""Effects in the exciters: loads that their force cells do not measure, and errors of their readings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.simulation.extensions.base import Extension

Array = NDArray[np.float64]

KINDS_WITH_EXCITERS = ("sweep", "check")
"""Kinds of run in which exciters apply the loads."""


@dataclass(frozen=True)
class ExciterMisalignment(Extension):
    """The exciter of the first component also applies a `fraction` of its load in the second, which is not measured."""

    name: ClassVar[str] = "exciter-misalignment"
    fraction: float = 0.0

    def true_loads(self, loads: Array, kind: str) -> Array:
        """The loads with the unmeasured part."""
        return _add_cross_axis(self, loads, self.fraction) if kind in KINDS_WITH_EXCITERS else loads


@dataclass(frozen=True)
class WeightMisalignment(Extension):
    """In static runs a `fraction` of the first component's load also acts in the second, where none is recorded."""

    name: ClassVar[str] = "weight-misalignment"
    fraction: float = 0.0

    def true_loads(self, loads: Array, kind: str) -> Array:
        """The loads with the part that is not recorded."""
        return _add_cross_axis(self, loads, self.fraction) if kind == "static" else loads


def _add_cross_axis(extension: Extension, loads: Array, fraction: float) -> Array:
    """Loads (n, 6) with a fraction of the first component of the place in the second."""
    applied, cross = extension.pair(COMPONENTS)
    loads = loads.copy()
    loads[:, cross] += fraction * loads[:, applied]
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
