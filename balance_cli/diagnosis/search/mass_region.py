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

from balance_cli.diagnosis.search.point_mass import MassScore, mass_parameter_indices, score_without_point_mass
from balance_cli.estimation.measurements import Batch
from balance_cli.model.balance import BalanceModel
from balance_cli.model.effects.geometry_scales import position_bound

Array = NDArray[np.float64]

CHI2_95 = 3.841458820694124
"""What chi-square may rise by within 95 % of one parameter."""
ROUNDS = 60
CHILDREN = 3000
# Places that are kept beside the extremes, and steps by chance, relative to the reach of the rig.
SURVIVORS = 600
WIDEST, NARROWEST = 0.3, 1e-5
# The longest stride along a difference, and by how much less than the best a place may gain and still be a parent.
STRIDE = 2.0
MAX_GAIN_DEFICIT = 12.0


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
    at = mass_parameter_indices(model)
    if at is None:
        return None
    return search_mass_region(
        score_without_point_mass(model, theta, batches, at), theta[at[1:]], position_bound(model.geometry)
    )


def mass_intervals(model: BalanceModel, theta: Array, batches: Sequence[Batch]) -> dict[str, tuple[float, float]]:
    """Intervals of 95 % of a point mass and its place, by the full names of the parameters; none without one."""
    region, at = mass_region(model, theta, batches), mass_parameter_indices(model)
    if region is None or at is None:
        return {}
    ends = ((float(lower), float(upper)) for lower, upper in region.intervals)
    return dict(zip((model.parameters.names[i] for i in at), ends, strict=True))


def search_mass_region(masses: MassScore, place: Array, far: float) -> MassRegion:
    """The region about the best `place` (3,), no coordinate further than `far` from the origin."""
    rng = np.random.default_rng(1985)
    population = _evaluate_places(masses, np.vstack([place, rng.uniform(-far, far, (CHILDREN, 3))]))
    for _ in range(ROUNDS):
        parents = population.places
        pick = rng.integers(len(parents), size=(3, CHILDREN))
        scale = far * np.exp(rng.uniform(np.log(NARROWEST), np.log(WIDEST), (CHILDREN, 1)))
        along = rng.uniform(0.0, STRIDE, (CHILDREN, 1)) * (parents[pick[1]] - parents[pick[2]])
        wander = rng.random((CHILDREN, 1)) < 0.5
        children = parents[pick[0]] + np.where(wander, scale * rng.standard_normal((CHILDREN, 3)), along)
        population = _select_survivors(
            _evaluate_places(masses, np.vstack([parents, np.clip(children, -far, far)])), rng
        )
    return MassRegion(population.ends())


@dataclass(frozen=True)
class _Population:
    """Places (n, 3), what a mass there gains at most (n,), that mass [kg] and the least and most that is allowed."""

    places: Array
    gain: Array
    mass: Array
    half_width: Array

    @property
    def gain_deficit(self) -> Array:
        """How much less a place gains than the best one (n,)."""
        return np.asarray(self.gain.max() - self.gain)

    def bounds(self) -> tuple[Array, Array]:
        """Mass and place at the lower and at the upper end of the mass (n, 4)."""
        low, high = (np.column_stack([self.mass + side * self.half_width, self.places]) for side in (-1.0, 1.0))
        return low, high

    def ends(self) -> Array:
        """Mass and place (4, 2, 4) at the least and the most of each parameter within the region."""
        inside = self.gain_deficit <= CHI2_95
        low, high = (part[inside] for part in self.bounds())
        pairs = [(low, high)] + 3 * [(np.column_stack([self.mass, self.places])[inside],) * 2]
        return np.array([[a[a[:, i].argmin()], b[b[:, i].argmax()]] for i, (a, b) in enumerate(pairs)])


def _evaluate_places(masses: MassScore, places: Array) -> _Population:
    slope, information = masses.at(places)
    gain = slope**2 / information
    half_width = np.sqrt(np.maximum(CHI2_95 - (gain.max() - gain), 0.0) / information)
    return _Population(places, gain, slope / information, half_width)


def _select_survivors(population: _Population, rng: np.random.Generator) -> _Population:
    """Some of the places near the region, and those at its ends."""
    near = np.flatnonzero(population.gain_deficit <= MAX_GAIN_DEFICIT)
    some = rng.permutation(near)[:SURVIVORS]
    best = np.argsort(population.gain_deficit)[: SURVIVORS // 10]
    inside = np.flatnonzero(population.gain_deficit <= CHI2_95)
    low, high = (part[inside] for part in population.bounds())
    ends = np.concatenate([inside[np.argsort(low, axis=0)[:5].ravel()], inside[np.argsort(-high, axis=0)[:5].ravel()]])
    index = np.unique(np.concatenate([some, best, ends]))
    return _Population(
        population.places[index], population.gain[index], population.mass[index], population.half_width[index]
    )
