"""The truth of a simulated run, and the independent random streams that generate it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.simulation.plans import HARMONICS
from balance_cli.simulation.rotor import harmonics

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RunTruth:
    """The truth of a run of n samples (or static rows), before any noise.

    `time` (n,) [s] (static: row numbers); `loads` (n, 6) the true hub loads at these times, not filtered;
    `recorded_loads` (n, 6) and `channels` (n, c) what the acquisition would have recorded without noise, rounding or
    clipping; `azimuth` (n,) [rad]; `cosine`, `sine` (9, 6): harmonics 0 to 8 of the true loads, from the samples
    between the first and the last pulse. The last three are None at rest.
    """

    name: str
    kind: str
    time: Array
    loads: Array
    recorded_loads: Array
    channels: Array
    azimuth: Array | None = None
    cosine: Array | None = None
    sine: Array | None = None

    def harmonics(self, start: float, stop: float) -> tuple[Array, Array]:
        """Cosine and sine parts (9, 6) of the true loads between `start` and `stop` [s]; the rotor must turn."""
        if self.azimuth is None:
            raise ValueError(f"the rotor does not turn in {self.name}")
        inside = (self.time >= start) & (self.time <= stop)
        return harmonics(self.azimuth[inside], self.loads[inside], HARMONICS)


def random_stream(seed: int, run: str, what: str) -> np.random.Generator:
    """An independent random stream for each run (by name) and purpose."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=tuple(f"{run}/{what}".encode())))
