"""Wald statistics of the effects of a model, and the confounding limit of effects that are not exactly known."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.diagnosis.search.candidates import parameters_of_interest
from balance_cli.diagnosis.selection.fit import Fit
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.coordinates import coordinates
from balance_cli.estimation.effect_inaccuracy import effect_inaccuracy
from balance_cli.estimation.identifiability import covariance_from_information
from balance_cli.model.placed_effects import PlacedEffect, declared_effects

Array = NDArray[np.float64]


def wald_statistic(fit: Fit, names: Iterable[str], nulls: Iterable[float]) -> tuple[float, int]:
    """Return Wald's chi-square of parameters against their nulls, and how many of them are identifiable.

    The other parameters are free. It is computed in the coordinates of the fit, in which the uncertainty of the scale
    of the rig, known from priors only, is not part of every stiffness. Of a fit that ended before its minimum it is
    computed at the minimum that its linearization predicts: a needless parameter may be many sigma from its null where
    the fit stopped.
    """
    parameters, theta = fit.model.parameters, fit.theta
    null, tested = theta.copy(), [parameters.index(name) for name in names]
    null[tested] = list(nulls)
    transform = coordinates(parameters, null)
    J = transform.jacobian(theta)[np.ix_(parameters.free, parameters.free)]
    total = fit.minimum.total
    covariance = covariance_from_information(J.T @ total.information @ J)
    departure = (transform.to_coordinates(theta) - transform.to_coordinates(null))[parameters.free]
    if not fit.minimum.converged:
        departure = _predicted_departure(departure, covariance @ (J.T @ total.gradient))
    identifiable = np.isin(np.flatnonzero(parameters.free), tested) & (np.diag(covariance) > 0)
    if not identifiable.any():
        return 0.0, 0
    block, d = covariance[np.ix_(identifiable, identifiable)], departure[identifiable]
    return float(d @ np.linalg.lstsq(block, d, rcond=1e-10)[0]), int(identifiable.sum())


def _predicted_departure(departure: Array, decrease: Array) -> Array:
    """The departures (f,) from the null after they decrease by so much, zero for those that would cross it."""
    predicted = departure - decrease
    return np.where(predicted * departure > 0, predicted, 0.0)


def effect_wald_statistic(fit: Fit, effect: PlacedEffect) -> tuple[float, int]:
    """Return Wald's chi-square of all parameters of interest of an effect, and how many of them are identifiable."""
    items = parameters_of_interest(effect.parameters)
    return wald_statistic(fit, [effect.full_name(item) for item in items], [item.fitted_null for item in items])


def shape_parameter_count(fit: Fit, effect: PlacedEffect) -> int:
    """Return how many fitted nuisance parameters shape an effect; zero for a single one, which a few starts scan."""
    parameters = fit.model.parameters
    free = [
        item
        for item in effect.parameters
        if item.nuisance and parameters.free[parameters.index(effect.full_name(item))]
    ]
    return len(free) if len(free) > 1 else 0


def confounding_limit(fit: Fit, batches: Sequence[Batch]) -> tuple[float, str]:
    """Return the chi-square that the inaccurate description of an effect may leave, and that effect's label.

    A candidate that gains no more than this may describe that inaccuracy. (0.0, "") where every effect is exact.
    """
    limits = []
    for effect in declared_effects(fit.geometry):
        share = effect_inaccuracy(effect.effect, batches)
        if share > 0:
            limits.append((share**2 * effect_wald_statistic(fit, effect)[0], effect.label))
    return max(limits, default=(0.0, ""))
