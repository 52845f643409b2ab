"""Two things that a rig may have and no effect of the library describes: the loop must not explain them away."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.simulation.extensions.base import Extension
from tests.support.unknown_effects import SaturatingChannel, TunedMass

Array = NDArray[np.float64]


def unknown_effect(name: str, channels: tuple[str, ...], rng: np.random.Generator) -> Extension:
    """One of the two, drawn: a mass of 0.1 to 2 kg at 30 to 110 Hz, or a channel that bends by 0.1 to 3 % at 2 V."""
    if name == TunedMass.name:
        direction = rng.standard_normal(3)
        direction /= np.linalg.norm(direction)
        return TunedMass(
            mass=float(np.exp(rng.uniform(np.log(0.1), np.log(2.0)))),
            frequency=float(rng.uniform(30.0, 110.0)),
            damping_ratio=float(rng.uniform(0.005, 0.03)),
            position=(float(rng.uniform(-0.3, 0.3)), float(rng.uniform(-0.3, 0.3)), float(rng.uniform(0.0, 0.5))),
            direction=(float(direction[0]), float(direction[1]), float(direction[2])),
        )
    bend = float(np.exp(rng.uniform(np.log(0.001), np.log(0.03))))
    return SaturatingChannel(where=(str(rng.choice(channels)),), limit=2.0 / np.sqrt(3.0 * bend))
