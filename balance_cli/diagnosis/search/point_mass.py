"""Where a point mass would gain most, for every place at once.

A mass m at p changes the mass matrix by m N(p)'N(p): linear in m, and with N linear in p a quadratic polynomial of p.
Ten masses at fixed points P_k, no three alike, span these:

    N(p)'N(p) = sum_k c_k(p) N(P_k)'N(P_k),        sum_k c_k(p) z(P_k) = z(p),   z(p) = [1, p, p p'] (10,)

so one score test of the ten (s, V, see `score`) tells what a mass would gain anywhere: (c's)^2 / (c'V c), at
m = c's / (c'V c). Its largest values, for a mass added and for one that is missing, are found from the best of a grid.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import FREEDOMS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.search.candidates import Candidate
from balance_cli.estimation.identifiability import covariance_from_information
from balance_cli.estimation.levenberg_marquardt import limit_to_bounds, prior_curvature
from balance_cli.estimation.likelihood import data_curvature
from balance_cli.estimation.maximum_likelihood import penalized_chi2, take_first_steps
from balance_cli.estimation.measurements import Batch
from balance_cli.estimation.starting_values import REGRESSION_PRIOR_SCALES
from balance_cli.model.balance import BalanceModel
from balance_cli.model.effects import EFFECTS, EffectParameter, Where, added_mass
from balance_cli.model.effects.geometry_scales import position_bound
from balance_cli.model.mechanics.dual_numbers import Dual
from balance_cli.model.mechanics.equations import Equations
from balance_cli.model.placed_effects import PlacedEffect, effect_parameters

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# Corners and mid-edges of a tetrahedron: on these a quadratic polynomial of three variables is known.
CORNERS = np.vstack([np.zeros(3), np.eye(3)])
EDGES = [0.5 * (CORNERS[i] + CORNERS[j]) for i in range(4) for j in range(i)]
POINTS = np.vstack([CORNERS, *EDGES])
# Points along each axis of the grid on which the top is sought.
GRID = 25
# Of a mass's information, what the fitted parameters leave at least: nothing is divided by rounding alone.
MIN_REMAINING_SHARE = 1e-12
# Steps of a fit of mass and place, and the chi-square that one must bring for a further one.
STEPS = 3
FOLLOW = 4
MIN_STEP_GAIN = 0.3


def place_mass_candidates(
    candidates: Sequence[Candidate], model: BalanceModel, theta: Array, batches: Sequence[Batch]
) -> tuple[Candidate, ...]:
    """The candidates, a point mass among them begun where it gains most, by more mass and by less.

    Not for a rig that cannot move in all six ways, where some places say the same.
    """
    if model.geometry.freedom != FREEDOMS or not any(_is_point_mass(one.one) for one in candidates):
        return tuple(candidates)
    score, far = score_of_masses(model, theta, batches), position_bound(model.geometry)
    starts = tuple(_best_place(score, sign, far).start for sign in (1.0, -1.0))
    return tuple(replace(one, starts=starts, chosen=3) if _is_point_mass(one.one) else one for one in candidates)


def refine_point_mass(model: BalanceModel, theta: Array, batches: Sequence[Batch]) -> Array:
    """Parameters from which a point mass in the model is soon fitted; `theta` itself where it has none, or no better.

    Steps of Gauss and Newton for the ten masses, of which each finds the one mass that suits best, wherever it is:
    along mass against arm chi-square is a narrow and curved valley.
    """
    at = mass_parameter_indices(model)
    if at is None:
        return theta
    others = _hold_point_mass(model, at)
    chi2 = penalized_chi2(model, theta, batches)
    for _ in range(STEPS):
        begun = _gauss_newton_step(others, theta, batches, at)
        if not np.isfinite(penalized_chi2(model, begun, batches)):
            return theta
        # Of everything: beside a narrow resonance the change of the mass was a large one.
        trial = take_first_steps(model, begun, batches, FOLLOW, REGRESSION_PRIOR_SCALES, MIN_STEP_GAIN).theta
        reached = penalized_chi2(model, trial, batches)
        if not reached < chi2 - MIN_STEP_GAIN:
            return trial if reached < chi2 else theta
        theta, chi2 = trial, reached
    return theta


def _gauss_newton_step(others: BalanceModel, theta: Array, batches: Sequence[Batch], at: Index) -> Array:
    """One step: mass and place, at indices `at` of theta, as they suit best, and the others as they then follow."""
    masses, far = score_without_point_mass(others, theta, batches, at), position_bound(others.geometry)
    best = max((_best_place(masses, sign, far) for sign in (1.0, -1.0)), key=lambda one: one.gain)
    found = theta.copy()
    change = _equivalent_masses(np.array([best.mass, *best.place])) - _equivalent_masses(theta[at])
    found[others.parameters.free] += masses.rest - masses.projection @ change
    found = limit_to_bounds(others.parameters, theta, found)
    found[at] = best.mass, *best.place
    return found


def mass_parameter_indices(model: BalanceModel) -> Index | None:
    """Where mass and place of a model's point mass stand among its parameters (4,); None without one."""
    own = next((one for one in model.effects if _is_point_mass(one)), None)
    if own is None or model.geometry.freedom != FREEDOMS:
        return None
    return np.array([model.parameters.index(own.full_name(item)) for item in own.parameters])


def score_without_point_mass(model: BalanceModel, theta: Array, batches: Sequence[Batch], at: Index) -> MassScore:
    """The score of the ten masses as if the model had no point mass, whose parameters are at indices `at` (4,)."""
    score = score_of_masses(_hold_point_mass(model, at), theta, batches)
    return replace(score, s=score.s + score.V @ _equivalent_masses(theta[at]))


def _hold_point_mass(model: BalanceModel, at: Index) -> BalanceModel:
    """The model with its point mass held."""
    return model.with_sigma(np.where(np.isin(np.arange(len(model.parameters)), at), 0.0, model.parameters.sigma))


def _equivalent_masses(mass_and_place: Array) -> Array:
    """The ten masses (10,) that do what one does, of mass and place (4,)."""
    return np.asarray(mass_and_place[0] * mass_weights(mass_and_place[1:][None])[0])


def _is_point_mass(one: PlacedEffect) -> bool:
    return one.effect is added_mass.EFFECT


@dataclass(frozen=True)
class MassScore:
    """s (10,) and V (10, 10) of masses at POINTS, all f fitted parameters projected out; `raw` (10, 10) is V before.

    By masses d (10,) these change by `rest` - `along` d, (f,) and (f, 10).
    """

    s: Array
    V: Array
    raw: Array
    rest: Array
    projection: Array

    def at(self, places: Array) -> tuple[Array, Array]:
        """Slope c's and information c'V c (n,) of a unit of mass at places (n, 3)."""
        c = mass_weights(places)
        least = MIN_REMAINING_SHARE * np.sum((c @ self.raw) * c, axis=1)
        return c @ self.s, np.maximum(np.sum((c @ self.V) * c, axis=1), least)


def score_of_masses(model: BalanceModel, theta: Array, batches: Sequence[Batch]) -> MassScore:
    """The score of ten masses at POINTS, beside what the model has at `theta` (p,)."""
    ten = PlacedEffect(MASSES, (), MASSES.parameters(model.geometry, ()), {})
    order = [effect.name for effect in EFFECTS]
    effects = sorted((*model.effects, ten), key=lambda one: order.index(one.effect.name))
    wide = BalanceModel(model.geometry, model.parameters + effect_parameters([ten]), tuple(effects))
    at = np.concatenate([theta, np.zeros(len(POINTS))])
    whole = data_curvature(batches, wide.system(at)) + prior_curvature(wide.parameters, at)
    fitted, own = slice(0, -len(POINTS)), slice(-len(POINTS), None)
    among, cross, raw = (whole.information[pair] for pair in ((fitted, fitted), (fitted, own), (own, own)))
    inverse = covariance_from_information(among)
    rest, projection = (_solve_refined(inverse, among, right) for right in (-whole.gradient[fitted], cross))
    # Mass, centre of gravity and inertia do what the ten do, so that nearly nothing is left: in this form it has no
    # error of first order in `along`.
    V = raw - cross.T @ projection - projection.T @ cross + projection.T @ among @ projection
    return MassScore(
        -(whole.gradient[own] - projection.T @ whole.gradient[fitted]), 0.5 * (V + V.T), raw, rest, projection
    )


def _solve_refined(inverse: Array, matrix: Array, right: Array) -> Array:
    """The solution of matrix x = right from an inverse that rounding has made inexact, once refined."""
    x = inverse @ right
    return np.asarray(x + inverse @ (right - matrix @ x))


@dataclass(frozen=True)
class _MassPlace:
    """A place (3,), what a mass there gains in chi-square, and that mass [kg]."""

    place: Array
    gain: float
    mass: float

    @property
    def start(self) -> dict[str, float]:
        """By the names of the effect's parameters."""
        return {"mass": self.mass, **dict(zip("xyz", map(float, self.place), strict=True))}


def _best_place(masses: MassScore, sign: float, far: float) -> _MassPlace:
    """Where, within `far` of the origin along each axis, more mass (`sign` 1) or less (-1) gains most."""
    from scipy.optimize import minimize as lowest

    def gain(places: Array) -> Array:
        slope, information = masses.at(places)
        return np.asarray(np.maximum(sign * slope, 0.0) ** 2 / information)

    def loss(place: Array) -> float:
        return -float(gain(place[None])[0])

    axis = np.linspace(-far, far, GRID)
    places = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    # The gain has a narrow ridge, mass against arm: no grid meets its top.
    end = lowest(loss, places[np.argmax(gain(places))], method="Nelder-Mead", bounds=[(-far, far)] * 3)
    slope, information = masses.at(np.asarray(end.x)[None])
    return _MassPlace(np.asarray(end.x), -float(end.fun), float(slope[0] / information[0]))


def mass_weights(places: Array) -> Array:
    """C (k, 10): what of each mass at POINTS makes a unit of mass at `places` (k, 3)."""
    return np.asarray(np.linalg.solve(_moments(POINTS).T, _moments(places).T).T)


def _moments(places: Array) -> Array:
    """Z (k, 10): one, the place, and its second moments."""
    i, j = np.triu_indices(3)
    return np.column_stack([np.ones(len(places)), places, places[:, i] * places[:, j]])


def _ten_mass_parameters(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    return tuple(EffectParameter(f"mass{k}", "kg", 0.0, 1.0, "A mass at a fixed point.") for k in range(len(POINTS)))


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Dual]) -> Equations:
    mass = equations.mass
    for k, point in enumerate(POINTS):
        motion = equations.motion(point)
        mass = mass + values[f"mass{k}"] * (motion.T @ motion)
    return replace(equations, mass=mass)


MASSES = replace(added_mass.EFFECT, parameters=_ten_mass_parameters, apply=_apply)
