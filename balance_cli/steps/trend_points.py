"""A run as one point of a trend: its loads in a few numbers, and its attributes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.recorded_time import recorded_time
from balance_cli.campaign.rig.components import UNIT_OF
from balance_cli.io.errors import UserError
from balance_cli.reduction.polar import polar_sigma
from balance_cli.reduction.result import RunLoads

Array = NDArray[np.float64]

SPEED = "speed"
MEAN = "mean"
SAME_SPEED = 0.01
"""Relative difference of rotor speeds within which runs are repeats: a tunnel holds the speed to some tenths of a
per cent."""
SECONDS_PER_DAY = 86400.0


@dataclass(frozen=True)
class TrendPoint:
    """The loads of one run, the file that they come from, and the harmonic of the blades."""

    file: str
    loads: RunLoads
    blades: int

    @property
    def run(self) -> str:
        """Name of the run."""
        return self.loads.run

    @property
    def components(self) -> tuple[str, ...]:
        """The load components."""
        return self.loads.components

    @property
    def quantities(self) -> tuple[str, str]:
        """The mean, and the amplitude of the harmonic of the blades."""
        return MEAN, f"{self.blades}/rev"

    @property
    def speed(self) -> float:
        """Mean rotor speed [Hz]."""
        return float(self.loads.frequency_hz[1])

    @property
    def attributes(self) -> dict[str, float | str]:
        """What runs can be compared by; `speed` is the mean rotor speed [Hz]."""
        conditions = self.loads.conditions
        own: dict[str, float | str] = {} if conditions is None else dict(conditions.attributes)
        if conditions is not None:
            own["rotor_speed"] = conditions.rotor_speed
            own |= {} if conditions.note is None else {"note": conditions.note}
        return own | {SPEED: self.speed, "kind": self.loads.kind, "trim": self.loads.trim}

    @property
    def recorded(self) -> float | None:
        """Time of the run [days], where its file states it in ISO 8601; UTC where it states no zone."""
        time = None if self.loads.conditions is None else recorded_time(self.loads.conditions.recorded)
        return None if time is None else time / SECONDS_PER_DAY

    def unit(self, component: str) -> str:
        """Return the unit of a component."""
        return UNIT_OF[component]

    def value(self, component: str, quantity: str) -> tuple[float, float]:
        """Return a quantity of a component and its sigma; NaN where the run has none."""
        m, n = self.components.index(component), 0 if quantity == MEAN else self.blades
        if n >= len(self.loads.frequency_hz):
            return math.nan, math.nan
        if n == 0:
            return float(self.loads.amplitude[0, m].real), float(self.loads.sigma_cosine[0, m])
        loads = self.loads
        sigma = polar_sigma(loads.amplitude, loads.sigma_cosine, loads.sigma_sine)[0]
        return float(abs(loads.amplitude[n, m])), float(sigma[n, m])


def attribute_values(points: Sequence[TrendPoint], name: str) -> Array:
    """Return a numeric attribute of all runs (n,), NaN where one has none.

    Raises UserError where no run has it, or it is text; the message names those that there are.
    """
    values = [point.attributes.get(name, math.nan) for point in points]
    known = sorted({key for point in points for key, value in point.attributes.items() if isinstance(value, float)})
    if not any(isinstance(value, float) and math.isfinite(value) for value in values):
        fault = f"no run has a number as attribute `{name}`"
        raise UserError(fault, "--by", remedy=f"Choose among {', '.join(known)}")
    return np.array([value if isinstance(value, float) else math.nan for value in values])


def sequence(points: Sequence[TrendPoint]) -> tuple[Array, str]:
    """Return the place of each run in the campaign (n,) and its unit.

    Days since the first where all runs state their time, else the number of the run in the order given.
    """
    times = [point.recorded for point in points]
    known = [time for time in times if time is not None]
    if len(known) == len(points) and len(set(known)) > 1:
        return np.array(known) - min(known), "days"
    return np.arange(len(points), dtype=float), "runs"


def repeats(points: Sequence[TrendPoint]) -> list[list[int]]:
    """Return the indices of the runs of the same conditions: speed within SAME_SPEED, all else equal, the note too."""
    groups: dict[str, list[int]] = {}
    for index, point in enumerate(points):
        conditions = {key: value for key, value in point.attributes.items() if key != SPEED}
        groups.setdefault(repr(sorted(conditions.items())), []).append(index)
    return [part for group in groups.values() for part in _of_one_speed(points, group)]


def _of_one_speed(points: Sequence[TrendPoint], group: list[int]) -> list[list[int]]:
    """Split runs where their speeds, in ascending order, differ from that of the first by more than SAME_SPEED."""
    parts: list[list[int]] = []
    for index in sorted(group, key=lambda item: points[item].speed):
        if parts and points[index].speed <= points[parts[-1][0]].speed * (1.0 + SAME_SPEED):
            parts[-1].append(index)
        else:
            parts.append([index])
    return [sorted(part) for part in parts]
