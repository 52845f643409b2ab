"""Mass properties of the moving part of a rig."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MovingPart:
    """The moving part as a whole: mass [kg], centre of gravity (3,) [m], inertia tensor about it (3, 3) [kg m2]."""

    mass: float
    centre_of_gravity: Array
    inertia: Array


def moving_part(geometry: Geometry) -> MovingPart:
    """Mass, centre of gravity and inertia of all bodies together (parallel axes theorem)."""
    masses = np.array([body.mass for body in geometry.bodies])
    positions = np.array([body.position for body in geometry.bodies])
    centre = masses @ positions / masses.sum()
    arms = positions - centre
    own = sum(body.inertia.tensor() for body in geometry.bodies)
    steiner = sum(m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in zip(masses, arms, strict=True))
    return MovingPart(float(masses.sum()), centre, own + steiner)
