"""Point masses: where a mass would gain most in chi-square, and the fit of a mass and its position.

The score of a mass at any position comes from ten masses at fixed points (see `mass_score`). Its largest values, for a
mass added and for one removed, are found from the best point of a grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import FREEDOMS
from balance_cli.diagnosis.search.candidates import Candidate
from balance_cli.diagnosis.search.mass_score import MassScore, equivalent_masses, score_of_masses
from balance_cli.diagnosis.settings import PointMassSettings, SearchSettings
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.levenberg_marquardt import limit_to_bounds, prior_curvature
from balance_cli.estimation.maximum_likelihood import penalized_chi2, take_first_steps
from balance_cli.estimation.starting_values import REGRESSION_PRIOR_SCALES
from balance_cli.model.balance import BalanceModel, Estimate
from balance_cli.model.effects.geometry_scales import position_bound

Array = NDArray[np.float64]
Index = NDArray[np.intp]


def place_mass_candidates(
    candidates: Sequence[Candidate], estimate: Estimate, batches: Sequence[Batch], settings: SearchSettings
) -> tuple[Candidate, ...]:
    """The candidates, with a point mass among them started where a mass added, and one removed, gains most.

    The candidates stay as they are for a rig that cannot move in all six ways, where several positions are equivalent.
    """
    hints = [candidate.effect.search.point_mass for candidate in candidates]
    if estimate.geometry.freedom != FREEDOMS or not any(hints):
        return tuple(candidates)
    far, limits = position_bound(estimate.geometry), settings.point_mass
    shares = (0.0, 1.0) if _has_strained_priors(estimate, limits) else (0.0,)
    best = [
        (place, share)
        for share in shares
        for place in _best_places(score_of_masses(estimate, batches, limits, share), far, limits)
    ]
    return tuple(
        candidate
        if names is None
        else replace(
            candidate,
            starts=tuple(
                {**dict(zip(names.names, place.values, strict=True)), names.damping_share: share}
                for place, share in best
            ),
            fitted_start_values=len(names.position),
        )
        for candidate, names in zip(candidates, hints, strict=True)
    )


def _has_strained_priors(estimate: Estimate, settings: PointMassSettings) -> bool:
    """Whether the parameters are improbably far from what is declared, as with a body that nobody has declared."""
    parameters = estimate.model.parameters
    count = np.count_nonzero(parameters.free & np.isfinite(parameters.sigma))
    return bool(
        prior_curvature(parameters, estimate.theta).chi2 > count + settings.strained_sigma * np.sqrt(2.0 * count)
    )


def refine_point_mass(start: Estimate, batches: Sequence[Batch], settings: SearchSettings) -> Estimate:
    """The values near the optimum of a model with a point mass; `start` itself without one, or where nothing is gained.

    Along mass against arm chi-square is a narrow and curved valley. Gauss-Newton steps of the ten masses, each of which
    gives the best single mass at any position, avoid it.
    """
    at = mass_parameter_indices(start.model)
    if at is None:
        return start
    best, chi2, min_gain = start, penalized_chi2(start, batches), settings.fit.min_step_gain
    for _ in range(settings.point_mass.steps):
        stepped = _gauss_newton_step(best, batches, at, settings.point_mass)
        if not np.isfinite(penalized_chi2(stepped, batches)):
            return best
        follow = settings.point_mass.follow_steps
        end = take_first_steps(stepped, batches, follow, REGRESSION_PRIOR_SCALES, min_gain)
        if not end.total.chi2 < chi2 - min_gain:
            return start.model.at(end.theta) if end.total.chi2 < chi2 else best
        best, chi2 = start.model.at(end.theta), end.total.chi2
    return best


def _gauss_newton_step(
    estimate: Estimate, batches: Sequence[Batch], at: Index, settings: PointMassSettings
) -> Estimate:
    """One step: the best mass and position, at indices `at` of theta, and the other parameters as they follow."""
    theta, parameters = estimate.theta, _hold_point_mass(estimate.model, at).parameters
    masses = score_without_point_mass(estimate, batches, at, settings)
    best = max(_best_places(masses, position_bound(estimate.geometry), settings), key=lambda place: place.gain)
    stepped = theta.copy()
    change = equivalent_masses(np.array(best.values)) - equivalent_masses(theta[at])
    stepped[parameters.free] += masses.fitted_step - masses.projection @ change
    stepped = limit_to_bounds(parameters, theta, stepped)
    stepped[at] = best.values
    return estimate.model.at(stepped)


def mass_parameter_indices(model: BalanceModel) -> Index | None:
    """Indices (4,) of mass and position of the point mass among the parameters of a model; None without one."""
    placed = next((item for item in model.effects if item.effect.search.point_mass), None)
    if placed is None or placed.effect.search.point_mass is None or model.geometry.freedom != FREEDOMS:
        return None
    names = placed.effect.search.point_mass.names
    return np.array([model.parameters.index(f"{placed.label}.{name}") for name in names])


def damping_share_index(model: BalanceModel) -> int:
    """Index of the share by which the plate's damping follows the point mass of a model."""
    placed = next(item for item in model.effects if item.effect.search.point_mass)
    assert placed.effect.search.point_mass is not None
    return model.parameters.index(f"{placed.label}.{placed.effect.search.point_mass.damping_share}")


def score_without_point_mass(
    estimate: Estimate, batches: Sequence[Batch], at: Index, settings: PointMassSettings
) -> MassScore:
    """The score of the ten masses as if the model had no point mass, whose parameters are at indices `at` (4,)."""
    share = estimate.theta[damping_share_index(estimate.model)]
    held = _hold_point_mass(estimate.model, at).at(estimate.theta)
    score = score_of_masses(held, batches, settings, float(share))
    return replace(score, s=score.s + score.V @ equivalent_masses(estimate.theta[at]))


def _hold_point_mass(model: BalanceModel, at: Index) -> BalanceModel:
    """The model with its point mass held."""
    return model.with_sigma(np.where(np.isin(np.arange(len(model.parameters)), at), 0.0, model.parameters.sigma))


@dataclass(frozen=True)
class _MassPlace:
    """A position (3,) [m], the gain in chi-square of a mass there, and that mass [kg]."""

    place: Array
    gain: float
    mass: float

    @property
    def values(self) -> tuple[float, float, float, float]:
        """The mass [kg] and its position [m]."""
        x, y, z = map(float, self.place)
        return self.mass, x, y, z


def _best_places(masses: MassScore, far: float, settings: PointMassSettings) -> list[_MassPlace]:
    """The best places of a mass added and of a mass removed, within `far` of the origin along each axis."""
    return [_best_place(masses, sign, far, settings.grid) for sign in (1.0, -1.0)]


def _best_place(masses: MassScore, sign: float, far: float, grid: int) -> _MassPlace:
    """Where, within `far` of the origin along each axis, a mass added (`sign` 1) or removed (-1) gains most."""
    from scipy.optimize import minimize

    def gain(places: Array) -> Array:
        score, information = masses.derivative_and_information(places)
        return np.asarray(np.maximum(sign * score, 0.0) ** 2 / information)

    def loss(place: Array) -> float:
        return -float(gain(place[None])[0])

    axis = np.linspace(-far, far, grid)
    places = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    # The gain has a narrow ridge, mass against arm, whose maximum lies between the points of any grid.
    optimum = minimize(loss, places[np.argmax(gain(places))], method="Nelder-Mead", bounds=[(-far, far)] * 3)
    score, information = masses.derivative_and_information(np.asarray(optimum.x)[None])
    return _MassPlace(np.asarray(optimum.x), -float(optimum.fun), float(score[0] / information[0]))
