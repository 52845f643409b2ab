"""Which masses at which places the data allow: the likelihood of a point mass over all places at once.

About a fit with s (10,) and V (10, 10) of ten masses (`point_mass`), counted from no mass, chi-square falls by

    gain(p, m) = 2 m c(p)'s - m^2 c(p)'V c(p),        at most (c's)^2 / (c'V c)

by a mass m at p. Mass and place lie in a curved valley, sometimes in two, of which sigma at the best one says little.
The region in which the gain is within 3.84 of the largest is searched by a crowd of places that moves along differences
of its own members (differential evolution, Storn and Price, 1997). Its extent along each parameter is the interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.search.point_mass import Masses, places_of_mass, whole_masses
from balance_cli.estimation.measurements import Batch
from balance_cli.model.balance import BalanceModel
from balance_cli.model.effects.base import reach

Array = NDArray[np.float64]

NINETY_FIVE = 3.841458820694124
"""What chi-square may rise by within 95 % of one parameter."""
ROUNDS = 60
CHILDREN = 3000
# Places that are kept beside the extremes, and steps by chance, relative to the reach of the rig.
KEPT = 600
WIDEST, NARROWEST = 0.3, 1e-5
# The longest stride along a difference, and by how much less than the best a place may gain and still be a parent.
STRIDE = 2.0
BEHIND = 12.0


@dataclass(frozen=True)
class MassRegion:
    """The ends (4, 2, 4) of each parameter (mass, x, y, z), lower and upper: mass and place there, in kg and m."""

    ends: Array

    @property
    def intervals(self) -> Array:
        """Lower and upper end (4, 2) of mass, x, y and z."""
        return np.stack([self.ends[i, :, i] for i in range(4)])


def mass_region(model: BalanceModel, theta: Array, batches: Sequence[Batch]) -> MassRegion | None:
    """The region of 95 % about a fit `theta` (p,) of a model with a point mass; None for one without."""
    at = places_of_mass(model)
    if at is None:
        return None
    return region_of(whole_masses(model, theta, batches, at), theta[at[1:]], reach(model.geometry))


def mass_intervals(model: BalanceModel, theta: Array, batches: Sequence[Batch]) -> dict[str, tuple[float, float]]:
    """Intervals of 95 % of a point mass and its place, by the full names of the parameters; none without one."""
    region, at = mass_region(model, theta, batches), places_of_mass(model)
    if region is None or at is None:
        return {}
    ends = ((float(lower), float(upper)) for lower, upper in region.intervals)
    return dict(zip((model.parameters.names[i] for i in at), ends, strict=True))


def region_of(masses: Masses, place: Array, far: float) -> MassRegion:
    """The region about the best `place` (3,), no coordinate further than `far` from the origin."""
    rng = np.random.default_rng(1985)
    crowd = _judged(masses, np.vstack([place, rng.uniform(-far, far, (CHILDREN, 3))]))
    for _ in range(ROUNDS):
        parents = crowd.places
        pick = rng.integers(len(parents), size=(3, CHILDREN))
        scale = far * np.exp(rng.uniform(np.log(NARROWEST), np.log(WIDEST), (CHILDREN, 1)))
        along = rng.uniform(0.0, STRIDE, (CHILDREN, 1)) * (parents[pick[1]] - parents[pick[2]])
        wander = rng.random((CHILDREN, 1)) < 0.5
        children = parents[pick[0]] + np.where(wander, scale * rng.standard_normal((CHILDREN, 3)), along)
        crowd = _kept(_judged(masses, np.vstack([parents, np.clip(children, -far, far)])), rng)
    return MassRegion(crowd.ends())


@dataclass(frozen=True)
class _Crowd:
    """Places (n, 3), what a mass there gains at most (n,), that mass [kg] and the least and most that is allowed."""

    places: Array
    gain: Array
    mass: Array
    half: Array

    @property
    def behind(self) -> Array:
        """How much less a place gains than the best one (n,)."""
        return np.asarray(self.gain.max() - self.gain)

    def bounds(self) -> tuple[Array, Array]:
        """Mass and place at the lower and at the upper end of the mass (n, 4)."""
        low, high = (np.column_stack([self.mass + side * self.half, self.places]) for side in (-1.0, 1.0))
        return low, high

    def ends(self) -> Array:
        """Mass and place (4, 2, 4) at the least and the most of each parameter within the region."""
        inside = self.behind <= NINETY_FIVE
        low, high = (part[inside] for part in self.bounds())
        pairs = [(low, high)] + 3 * [(np.column_stack([self.mass, self.places])[inside],) * 2]
        return np.array([[a[a[:, i].argmin()], b[b[:, i].argmax()]] for i, (a, b) in enumerate(pairs)])


def _judged(masses: Masses, places: Array) -> _Crowd:
    slope, information = masses.at(places)
    gain = slope**2 / information
    half = np.sqrt(np.maximum(NINETY_FIVE - (gain.max() - gain), 0.0) / information)
    return _Crowd(places, gain, slope / information, half)


def _kept(crowd: _Crowd, rng: np.random.Generator) -> _Crowd:
    """Some of the places near the region, and those at its ends."""
    near = np.flatnonzero(crowd.behind <= BEHIND)
    some = rng.permutation(near)[:KEPT]
    best = np.argsort(crowd.behind)[: KEPT // 10]
    inside = np.flatnonzero(crowd.behind <= NINETY_FIVE)
    low, high = (part[inside] for part in crowd.bounds())
    ends = np.concatenate([inside[np.argsort(low, axis=0)[:5].ravel()], inside[np.argsort(-high, axis=0)[:5].ravel()]])
    index = np.unique(np.concatenate([some, best, ends]))
    return _Crowd(crowd.places[index], crowd.gain[index], crowd.mass[index], crowd.half[index])
