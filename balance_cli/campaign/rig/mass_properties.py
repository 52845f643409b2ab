"""Mass properties of the metric side of a rig."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MetricSide:
    """The metric side as a whole: mass [kg], center of gravity (3,) [m], inertia tensor about it (3, 3) [kg m2]."""

    mass: float
    centre_of_gravity: Array
    inertia: Array


def metric_side(geometry: Geometry) -> MetricSide:
    """Mass, center of gravity and inertia of all bodies together (parallel-axis theorem)."""
    masses = np.array([body.mass for body in geometry.bodies])
    positions = np.array([body.position for body in geometry.bodies])
    center = masses @ positions / masses.sum()
    arms = positions - center
    own = sum(body.inertia.tensor() for body in geometry.bodies)
    steiner = sum(m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in zip(masses, arms, strict=True))
    return MetricSide(float(masses.sum()), center, own + steiner)
