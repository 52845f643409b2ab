"""The score of a point mass at every position at once.

A mass m at p changes the mass matrix by m N(p)'N(p): linear in m, and with N linear in p a quadratic polynomial of p.
Ten masses at fixed points P_k in general position therefore span all of them:

    N(p)'N(p) = sum_k c_k(p) N(P_k)'N(P_k),        sum_k c_k(p) z(P_k) = z(p),   z(p) = [1, p, p p'] (10,)

One score test of the ten masses (s, V, see `score_statistics`) thus gives the gain of a mass at any position,
(c's)^2 / (c'V c), with m = c's / (c'V c).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.search.projected_scores import solve_refined
from balance_cli.diagnosis.settings import PointMassSettings
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.identifiability import covariance_from_information
from balance_cli.estimation.levenberg_marquardt import prior_curvature
from balance_cli.estimation.likelihood import data_curvature
from balance_cli.model.balance import BalanceModel, Estimate
from balance_cli.model.effects import EFFECTS, Effect, EffectParameter, Where
from balance_cli.model.effects.added_mass import add_mass
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations
from balance_cli.model.placed_effects import PlacedEffect, effect_parameters

Array = NDArray[np.float64]

CORNERS = np.vstack([np.zeros(3), np.eye(3)])
EDGES = [0.5 * (CORNERS[i] + CORNERS[j]) for i in range(4) for j in range(i)]
POINTS = np.vstack([CORNERS, *EDGES])
"""Corners and mid-edges of a tetrahedron, which determine a quadratic polynomial of three variables."""


@dataclass(frozen=True)
class MassScore:
    """Score s (10,) and information V (10, 10) of masses at POINTS, with all f fitted parameters projected out.

    `raw` (10, 10) is V before the projection. Masses d (10,) change the fitted parameters by `fitted_step` -
    `projection` d, (f,) and (f, 10). `min_remaining_share`: see `PointMassSettings`.
    """

    s: Array
    V: Array
    raw: Array
    fitted_step: Array
    projection: Array
    min_remaining_share: float

    def derivative_and_information(self, places: Array) -> tuple[Array, Array]:
        """Score c's and information c'V c (n,) of a unit mass at places (n, 3)."""
        c = mass_weights(places)
        least = self.min_remaining_share * np.sum((c @ self.raw) * c, axis=1)
        return c @ self.s, np.maximum(np.sum((c @ self.V) * c, axis=1), least)


def score_of_masses(
    estimate: Estimate, batches: Sequence[Batch], settings: PointMassSettings, damping_share: float = 0.0
) -> MassScore:
    """The score of ten masses at POINTS in addition to the effects of the model.

    The plate's damping follows the masses by `damping_share`.
    """
    wide = _with_ten_masses(estimate.model, damping_share)
    at = np.concatenate([estimate.theta, np.zeros(len(POINTS))])
    curvature = data_curvature(batches, wide.system(at)) + prior_curvature(wide.parameters, at)
    fitted, masses = slice(0, -len(POINTS)), slice(-len(POINTS), None)
    among, cross, raw = (curvature.information[pair] for pair in ((fitted, fitted), (fitted, masses), (masses, masses)))
    inverse = covariance_from_information(among)
    fitted_step, projection = (solve_refined(inverse, among, right) for right in (-curvature.gradient[fitted], cross))
    # Mass, center of gravity and inertia do nearly the same as the ten masses, so that V is a small difference. In this
    # form it has no error of first order in `projection`.
    V = raw - cross.T @ projection - projection.T @ cross + projection.T @ among @ projection
    s = -(curvature.gradient[masses] - projection.T @ curvature.gradient[fitted])
    return MassScore(s, 0.5 * (V + V.T), raw, fitted_step, projection, settings.min_remaining_share)


def _with_ten_masses(model: BalanceModel, damping_share: float) -> BalanceModel:
    """The model with ten masses at POINTS, whose parameters are the last ones."""
    effect = _ten_masses(next(effect for effect in EFFECTS if effect.search.point_mass is not None), damping_share)
    masses = PlacedEffect(effect, (), effect.parameters(model.geometry, ()), {})
    order = [item.name for item in EFFECTS]
    effects = sorted((*model.effects, masses), key=lambda placed: order.index(placed.effect.name))
    return BalanceModel(model.geometry, model.parameters + effect_parameters([masses]), tuple(effects))


def _ten_masses(point_mass: Effect, damping_share: float) -> Effect:
    """The effect of ten masses at POINTS, which acts where the effect of one mass does."""

    def parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
        names = [f"mass{k}" for k in range(len(POINTS))]
        return tuple(EffectParameter(name, "kg", 0.0, 1.0, "A mass at a fixed point.") for name in names)

    def apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
        motions = [equations.motion(point) for point in POINTS]
        parts = [values[f"mass{k}"] * (motion.T @ motion) for k, motion in enumerate(motions)]
        return add_mass(equations, sum(parts[1:], parts[0]), damping_share)

    return replace(point_mass, parameters=parameters, apply=apply)


def equivalent_masses(mass_and_place: Array) -> Array:
    """The ten masses (10,) equivalent to one mass, given as mass and position (4,)."""
    return np.asarray(mass_and_place[0] * mass_weights(mass_and_place[1:][None])[0])


def mass_weights(places: Array) -> Array:
    """Masses C (k, 10) at POINTS that are equivalent to a unit mass at each of `places` (k, 3)."""
    return np.asarray(np.linalg.solve(_moments(POINTS).T, _moments(places).T).T)


def _moments(places: Array) -> Array:
    """Z (k, 10): one, the position, and its second moments."""
    i, j = np.triu_indices(3)
    return np.column_stack([np.ones(len(places)), places, places[:, i] * places[:, j]])
