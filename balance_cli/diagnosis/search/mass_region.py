"""The region of masses and positions that the data allow: the likelihood of a point mass over all positions at once.

Near a fit with s (10,) and V (10, 10) of ten masses (see `mass_score`), relative to no mass, chi-square falls by

    gain(p, m) = 2 m c(p)'s - m^2 c(p)'V c(p),        at most (c's)^2 / (c'V c)

by a mass m at p. Mass and position lie in a curved valley, sometimes in two, which the covariance at the best point
does not describe. The region in which the gain is within 3.84 of the largest is searched by a population of positions
that moves along differences of its members (differential evolution, Storn and Price, J. Global Optim. 11 (1997) 341).
Its extent along each parameter is the 95 % interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.search.mass_score import MassScore
from balance_cli.diagnosis.search.point_mass import mass_parameter_indices, score_without_point_mass
from balance_cli.diagnosis.settings import MassRegionSettings, SearchSettings
from balance_cli.estimation.batch import Batch
from balance_cli.model.balance import Estimate
from balance_cli.model.effects.geometry_scales import position_bound

Array = NDArray[np.float64]

CHI2_95 = 3.841458820694124
"""95 % point of chi-square with one degree of freedom."""


@dataclass(frozen=True)
class MassRegion:
    """The ends (4, 2, 4) of each parameter (mass, x, y, z), lower and upper: mass [kg] and position [m] there."""

    ends: Array

    @property
    def intervals(self) -> Array:
        """Lower and upper end (4, 2) of mass, x, y and z."""
        return np.stack([self.ends[i, :, i] for i in range(4)])


def mass_region(fit: Estimate, batches: Sequence[Batch], settings: SearchSettings) -> MassRegion | None:
    """The 95 % region about a fit of a model with a point mass; None without one."""
    at = mass_parameter_indices(fit.model)
    if at is None:
        return None
    score = score_without_point_mass(fit, batches, at, settings.point_mass)
    return search_mass_region(score, fit.theta[at[1:]], position_bound(fit.geometry), settings.mass_region)


def mass_intervals(fit: Estimate, batches: Sequence[Batch], settings: SearchSettings) -> dict[str, tuple[float, float]]:
    """95 % intervals of a point mass and its position, by full parameter names; empty without a point mass.

    Empty, too, where the fit does not lie in its region: it is not at the minimum, and the region is that of no fit.
    """
    region, at = mass_region(fit, batches, settings), mass_parameter_indices(fit.model)
    if region is None or at is None:
        return {}
    lowest, highest = region.intervals.T
    if np.any((fit.theta[at] < lowest) | (fit.theta[at] > highest)):
        return {}
    ends = ((float(lower), float(upper)) for lower, upper in region.intervals)
    return dict(zip((fit.model.parameters.names[i] for i in at), ends, strict=True))


def search_mass_region(masses: MassScore, place: Array, far: float, settings: MassRegionSettings) -> MassRegion:
    """The region about the best position `place` (3,), with no coordinate beyond `far` from the origin."""
    rng, count = np.random.default_rng(settings.seed), settings.children
    population = _evaluate_places(masses, np.vstack([place, rng.uniform(-far, far, (count, 3))]))
    for _ in range(settings.rounds):
        children = _move_places(population.places, far, rng, settings)
        places = np.vstack([population.places, np.clip(children, -far, far)])
        population = _select_survivors(_evaluate_places(masses, places), rng, settings)
    return MassRegion(population.ends())


def _move_places(parents: Array, far: float, rng: np.random.Generator, settings: MassRegionSettings) -> Array:
    """New places (children, 3): each a parent moved along a difference of two others, or by a random step."""
    count = settings.children
    pick = rng.integers(len(parents), size=(3, count))
    widths = np.log(settings.narrowest_step), np.log(settings.widest_step)
    scale = far * np.exp(rng.uniform(*widths, (count, 1)))
    difference = rng.uniform(0.0, settings.stride, (count, 1)) * (parents[pick[1]] - parents[pick[2]])
    is_random = rng.random((count, 1)) < 0.5
    return np.asarray(parents[pick[0]] + np.where(is_random, scale * rng.standard_normal((count, 3)), difference))


@dataclass(frozen=True)
class _Population:
    """Positions (n, 3), the largest gain (n,) of a mass there, that mass [kg], and half the width of its interval."""

    places: Array
    gain: Array
    mass: Array
    half_width: Array

    @property
    def gain_deficit(self) -> Array:
        """The gain of the best position less that of each one (n,)."""
        return np.asarray(self.gain.max() - self.gain)

    def bounds(self) -> tuple[Array, Array]:
        """Mass and position (n, 4) at the lower and at the upper end of the mass."""
        low, high = (np.column_stack([self.mass + side * self.half_width, self.places]) for side in (-1.0, 1.0))
        return low, high

    def ends(self) -> Array:
        """Mass and position (4, 2, 4) at the smallest and the largest value of each parameter in the region."""
        inside = self.gain_deficit <= CHI2_95
        low, high = (part[inside] for part in self.bounds())
        pairs = [(low, high)] + 3 * [(np.column_stack([self.mass, self.places])[inside],) * 2]
        return np.array([[a[a[:, i].argmin()], b[b[:, i].argmax()]] for i, (a, b) in enumerate(pairs)])


def _evaluate_places(masses: MassScore, places: Array) -> _Population:
    derivative, information = masses.derivative_and_information(places)
    gain = derivative**2 / information
    half_width = np.sqrt(np.maximum(CHI2_95 - (gain.max() - gain), 0.0) / information)
    return _Population(places, gain, derivative / information, half_width)


def _select_survivors(population: _Population, rng: np.random.Generator, settings: MassRegionSettings) -> _Population:
    """A random choice of the positions near the region, the best ones, and those at its ends."""
    near = np.flatnonzero(population.gain_deficit <= settings.max_gain_deficit)
    sample = rng.permutation(near)[: settings.survivors]
    best = np.argsort(population.gain_deficit)[: settings.survivors // 10]
    inside = np.flatnonzero(population.gain_deficit <= CHI2_95)
    low, high = (part[inside] for part in population.bounds())
    lower_ends = inside[np.argsort(low, axis=0)[: settings.end_places].ravel()]
    upper_ends = inside[np.argsort(-high, axis=0)[: settings.end_places].ravel()]
    index = np.unique(np.concatenate([sample, best, lower_ends, upper_ends]))
    return _Population(
        population.places[index], population.gain[index], population.mass[index], population.half_width[index]
    )
