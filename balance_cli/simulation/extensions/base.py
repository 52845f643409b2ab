"""The interface of effects of a simulated rig beyond the rigid plate: one class per effect."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.errors import UserError
from balance_cli.simulation.mechanics import Mechanics

Array = NDArray[np.float64]
ALL = "all"


@dataclass(frozen=True)
class Signals:
    """Volts (n, channels) before the anti-alias filter, sampled every `step` s.

    Without a `step` the rows are readings at rest, one for each static load point. `rng` is for values that differ
    between runs.
    """

    volts: Array
    names: tuple[str, ...]
    step: float | None
    rng: np.random.Generator


@dataclass(frozen=True)
class Extension:
    """An effect at the places `where`; its other fields are its parameters. A hook not overridden changes nothing."""

    name: ClassVar[str]
    is_mixture: ClassVar[bool] = False
    """Whether each of its volts is a sum of present ones and a constant: then they may be filtered before it, too."""
    where: tuple[str, ...] = ()

    def mechanics(self, mechanics: Mechanics, geometry: Geometry, rotor_speed: float) -> Mechanics:
        """The equations of motion with the effect, at `rotor_speed` [Hz]."""
        return mechanics

    def true_loads(self, loads: Array, kind: str) -> Array:
        """True hub loads (n, 6) of a run of this kind where the exciters' force cells are loaded by `loads` (n, 6)."""
        return loads

    def exciter_mechanics(self, mechanics: Mechanics, attached: Collection[str]) -> Mechanics:
        """The equations of motion with the exciters of these load components `attached` to the hub."""
        return mechanics

    def recorded_loads(self, loads: Array, kind: str, step: float | None = None) -> Array:
        """Recorded loads (n, 6) of a run of this kind where the exciters' force cells are loaded by `loads` (n, 6).

        They are sampled every `step` s; without one they are those of static load points.
        """
        return loads

    def loads_from_recorded(self, recorded: Array, kind: str, step: float) -> Array:
        """Loads (n, 6) of the force cells for recorded ones, the inverse of `recorded_loads` but for means."""
        return recorded

    def volts(self, signals: Signals) -> Array:
        """Volts (n, channels) with the effect."""
        return signals.volts

    def places(self, names: tuple[str, ...]) -> list[int]:
        """Indices of `where` among `names` (`all`: every one). Raises UserError for an unknown place."""
        if self.where == (ALL,):
            return list(range(len(names)))
        unknown = [place for place in self.where if place not in names]
        if unknown or not self.where:
            fault = f"`{self.name}` acts at {', '.join(names)}, not at {', '.join(unknown) or 'nothing'}"
            raise UserError(fault, place="effects", remedy="Correct `where`")
        return [names.index(place) for place in self.where]

    def pair(self, names: tuple[str, ...]) -> tuple[int, int]:
        """Indices of the two places among `names`. Raises UserError where there are not two."""
        places = self.places(names)
        if len(places) != 2 or places[0] == places[1]:
            raise UserError(f"`{self.name}` needs two different places", place="effects", remedy="Correct `where`")
        return places[0], places[1]
