"""Effects beyond the rigid plate, in the time domain: what an extension may do to a simulated rig."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from balance_cli.simulation.mechanics import Mechanics
from balance_cli.simulation.rig import TrueRig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Signals:
    """Volts (n, channels) before the anti-alias filter, sampled every `step` s; `rng` for what no two runs share.

    Without a `step` the rows are readings at rest, one for each static load point.
    """

    volts: Array
    names: tuple[str, ...]
    step: float | None
    rng: np.random.Generator


@dataclass(frozen=True)
class Extension:
    """An effect at the places `where`. Each hook leaves everything as it is unless the effect says otherwise."""

    name: ClassVar[str]
    stage: ClassVar[int] = 0
    where: tuple[str, ...] = ()

    def mechanics(self, mechanics: Mechanics, rig: TrueRig, rotor_speed: float) -> Mechanics:
        """The equations of motion with the effect, at `rotor_speed` [Hz]."""
        return mechanics

    def true_loads(self, loads: Array, kind: str) -> Array:
        """True hub loads (n, 6) of a run of this kind where `loads` (n, 6) were meant to act."""
        return loads

    def volts(self, signals: Signals) -> Array:
        """Volts (n, channels) with the effect."""
        return signals.volts

    def recorded_loads(self, loads: Array, kind: str) -> Array:
        """Recorded loads (n, 6) of a run of this kind where the exciter's force cell feels `loads` (n, 6)."""
        return loads
