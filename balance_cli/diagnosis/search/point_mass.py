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
from balance_cli.estimation.identifiability import covariance_of
from balance_cli.estimation.levenberg_marquardt import prior_curvature, within_bounds
from balance_cli.estimation.likelihood import data_curvature
from balance_cli.estimation.maximum_likelihood import first_steps, penalised_chi2
from balance_cli.estimation.measurements import Batch
from balance_cli.estimation.starting_values import NEAR
from balance_cli.model.balance import BalanceModel
from balance_cli.model.effects import EFFECTS, EffectParameter, Where, added_mass
from balance_cli.model.effects.base import reach
from balance_cli.model.mechanics.dual_numbers import Jet
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
LEAST_SHARE = 1e-12
# Steps of a fit of mass and place, and the chi-square that one must bring for a further one.
STEPS = 3
FOLLOW = 4
PROMISED = 0.3


def well_placed(
    candidates: Sequence[Candidate], model: BalanceModel, theta: Array, batches: Sequence[Batch]
) -> tuple[Candidate, ...]:
    """The candidates, a point mass among them begun where it gains most, by more mass and by less.

    Not for a rig that cannot move in all six ways, where some places say the same.
    """
    if model.geometry.freedom != FREEDOMS or not any(_is_mass(one.one) for one in candidates):
        return tuple(candidates)
    score, far = score_of_masses(model, theta, batches), reach(model.geometry)
    starts = tuple(_best(score, sign, far).start for sign in (1.0, -1.0))
    return tuple(replace(one, starts=starts, chosen=3) if _is_mass(one.one) else one for one in candidates)


def settled_mass(model: BalanceModel, theta: Array, batches: Sequence[Batch]) -> Array:
    """Parameters from which a point mass in the model is soon fitted; `theta` itself where it has none, or no better.

    Steps of Gauss and Newton for the ten masses, of which each finds the one mass that suits best, wherever it is:
    along mass against arm chi-square is a narrow and curved valley.
    """
    at = places_of_mass(model)
    if at is None:
        return theta
    others = _without(model, at)
    chi2 = penalised_chi2(model, theta, batches)
    for _ in range(STEPS):
        begun = _step(others, theta, batches, at)
        if not np.isfinite(penalised_chi2(model, begun, batches)):
            return theta
        # Of everything: beside a narrow resonance the change of the mass was a large one.
        trial = first_steps(model, begun, batches, FOLLOW, NEAR, PROMISED).theta
        reached = penalised_chi2(model, trial, batches)
        if not reached < chi2 - PROMISED:
            return trial if reached < chi2 else theta
        theta, chi2 = trial, reached
    return theta


def _step(others: BalanceModel, theta: Array, batches: Sequence[Batch], at: Index) -> Array:
    """One step: mass and place, at indices `at` of theta, as they suit best, and the others as they then follow."""
    masses, far = whole_masses(others, theta, batches, at), reach(others.geometry)
    best = max((_best(masses, sign, far) for sign in (1.0, -1.0)), key=lambda one: one.gain)
    found = theta.copy()
    change = _ten_of(np.array([best.mass, *best.place])) - _ten_of(theta[at])
    found[others.parameters.free] += masses.rest - masses.along @ change
    found = within_bounds(others.parameters, theta, found)
    found[at] = best.mass, *best.place
    return found


def places_of_mass(model: BalanceModel) -> Index | None:
    """Where mass and place of a model's point mass stand among its parameters (4,); None without one."""
    own = next((one for one in model.effects if _is_mass(one)), None)
    if own is None or model.geometry.freedom != FREEDOMS:
        return None
    return np.array([model.parameters.index(own.full_name(item)) for item in own.parameters])


def whole_masses(model: BalanceModel, theta: Array, batches: Sequence[Batch], at: Index) -> Masses:
    """The score of the ten masses as if the model had no point mass, whose parameters are at indices `at` (4,)."""
    score = score_of_masses(_without(model, at), theta, batches)
    return replace(score, s=score.s + score.V @ _ten_of(theta[at]))


def _without(model: BalanceModel, at: Index) -> BalanceModel:
    """The model with its point mass held."""
    return model.with_sigma(np.where(np.isin(np.arange(len(model.parameters)), at), 0.0, model.parameters.sigma))


def _ten_of(mass_and_place: Array) -> Array:
    """The ten masses (10,) that do what one does, of mass and place (4,)."""
    return np.asarray(mass_and_place[0] * shares(mass_and_place[1:][None])[0])


def _is_mass(one: PlacedEffect) -> bool:
    return one.effect is added_mass.EFFECT


@dataclass(frozen=True)
class Masses:
    """s (10,) and V (10, 10) of masses at POINTS, all f fitted parameters projected out; `raw` (10, 10) is V before.

    By masses d (10,) these change by `rest` - `along` d, (f,) and (f, 10).
    """

    s: Array
    V: Array
    raw: Array
    rest: Array
    along: Array

    def at(self, places: Array) -> tuple[Array, Array]:
        """Slope c's and information c'V c (n,) of a unit of mass at places (n, 3)."""
        c = shares(places)
        least = LEAST_SHARE * np.sum((c @ self.raw) * c, axis=1)
        return c @ self.s, np.maximum(np.sum((c @ self.V) * c, axis=1), least)


def score_of_masses(model: BalanceModel, theta: Array, batches: Sequence[Batch]) -> Masses:
    """The score of ten masses at POINTS, beside what the model has at `theta` (p,)."""
    ten = PlacedEffect(MASSES, (), MASSES.parameters(model.geometry, ()), {})
    order = [effect.name for effect in EFFECTS]
    effects = sorted((*model.effects, ten), key=lambda one: order.index(one.effect.name))
    wide = BalanceModel(model.geometry, model.parameters + effect_parameters([ten]), tuple(effects))
    at = np.concatenate([theta, np.zeros(len(POINTS))])
    whole = data_curvature(batches, wide.system(at)) + prior_curvature(wide.parameters, at)
    fitted, own = slice(0, -len(POINTS)), slice(-len(POINTS), None)
    among, cross, raw = (whole.information[pair] for pair in ((fitted, fitted), (fitted, own), (own, own)))
    inverse = covariance_of(among)
    rest, along = (_solved(inverse, among, right) for right in (-whole.gradient[fitted], cross))
    # Mass, centre of gravity and inertia do what the ten do, so that nearly nothing is left: in this form it has no
    # error of first order in `along`.
    V = raw - cross.T @ along - along.T @ cross + along.T @ among @ along
    return Masses(-(whole.gradient[own] - along.T @ whole.gradient[fitted]), 0.5 * (V + V.T), raw, rest, along)


def _solved(inverse: Array, matrix: Array, right: Array) -> Array:
    """The solution of matrix x = right from an inverse that rounding has made inexact, once refined."""
    x = inverse @ right
    return np.asarray(x + inverse @ (right - matrix @ x))


@dataclass(frozen=True)
class _Place:
    """A place (3,), what a mass there gains in chi-square, and that mass [kg]."""

    place: Array
    gain: float
    mass: float

    @property
    def start(self) -> dict[str, float]:
        """By the names of the effect's parameters."""
        return {"mass": self.mass, **dict(zip("xyz", map(float, self.place), strict=True))}


def _best(masses: Masses, sign: float, far: float) -> _Place:
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
    return _Place(np.asarray(end.x), -float(end.fun), float(slope[0] / information[0]))


def shares(places: Array) -> Array:
    """C (k, 10): what of each mass at POINTS makes a unit of mass at `places` (k, 3)."""
    return np.asarray(np.linalg.solve(_moments(POINTS).T, _moments(places).T).T)


def _moments(places: Array) -> Array:
    """Z (k, 10): one, the place, and its second moments."""
    i, j = np.triu_indices(3)
    return np.column_stack([np.ones(len(places)), places, places[:, i] * places[:, j]])


def _ten(geometry: Geometry, where: Where) -> tuple[EffectParameter, ...]:
    return tuple(EffectParameter(f"mass{k}", "kg", 0.0, 1.0, "A mass at a fixed point.") for k in range(len(POINTS)))


def _apply(equations: Equations, geometry: Geometry, where: Where, values: Mapping[str, Jet]) -> Equations:
    mass = equations.mass
    for k, point in enumerate(POINTS):
        motion = equations.motion(point)
        mass = mass + values[f"mass{k}"] * (motion.T @ motion)
    return replace(equations, mass=mass)


MASSES = replace(added_mass.EFFECT, parameters=_ten, apply=_apply)
