"""Worth of an effect: what forgetting it does to the harmonic hub loads at the rotor speed, over their sigma.

A model without the effect has the response T0 instead of T, its other parameters being fitted to the same data. Of an
effect that takes little off chi-square they follow to first order, with information I (f: other parameters, e: those of
the effect): d_f = -I_ff^-1 I_fe d_e. One that takes off more is forgotten in a fit of some of the lines, weighted with
the error that is then left (`search.refit`), and T is fitted to the same lines with the same weights, so that their
noise is in both. Channels that read T u for loads u are reduced to G0 T u with G0 = (T0* C^-1 T0)^-1 T0* C^-1, and

    worth_i = max over harmonics and loads of |(G0 T u - u)_i| / sigma_i

where u is each swept load alone at its level, and sigma that of the loads by the whole model: noise C of the channels
as in the sweeps, and the covariance of the parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.diagnosis.search.candidates import parameters_of_interest
from balance_cli.diagnosis.search.extended_models import extend_model
from balance_cli.diagnosis.search.refit import fit_until_stable, take_steps
from balance_cli.diagnosis.search.search_lines import SearchLines
from balance_cli.diagnosis.selection.effect_selection import without_effect
from balance_cli.diagnosis.selection.effect_statistics import effect_wald_statistic
from balance_cli.diagnosis.selection.fit import Fit, select_every_nth_line
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS, SearchSettings, WorthSettings
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.identifiability import covariance_from_information
from balance_cli.estimation.levenberg_marquardt import limit_to_bounds
from balance_cli.estimation.maximum_likelihood import penalized_chi2
from balance_cli.estimation.model_error import add_model_error
from balance_cli.model.balance import Estimate
from balance_cli.model.placed_effects import PlacedEffect
from balance_cli.model.response_jacobian import output_jacobian
from balance_cli.model.system import System
from balance_cli.model.system_response import Solution, response, solve

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class _Harmonics:
    """Frequencies (h,) [Hz], variance (h, c) of the channels there, and the swept components with their levels (u,).

    `spin` [Hz] is the speed at which the loads are reduced: what spins acts there, though the sweeps were made at rest.
    """

    spin: float
    frequency: Array
    variance: Array
    components: Index
    levels: Array


def effect_worth(
    fit: Fit, effect: PlacedEffect, batches: Sequence[Batch], settings: SearchSettings = DEFAULT_SETTINGS
) -> dict[str, float] | None:
    """Return the worth of an effect of a fit by load component.

    None where it cannot be told: without a rotor speed or enough channels, and of effects that are not a part of the
    linear response, such as offsets of loads, tones and nonlinear forces. The zero of a channel moves no harmonic load
    of a linear model.
    """
    if effect.effect.is_zero_reading and not fit.system().equations.has_nonlinear_terms:
        return dict.fromkeys(_swept_components(batches), 0.0)
    harmonics = _harmonics(fit, batches, settings.worth)
    if harmonics is None or effect.effect.needs_mean:
        return None
    try:
        return _worth(fit, *compared_systems(fit, effect, batches, settings), harmonics)
    except np.linalg.LinAlgError:
        return None


def compared_systems(
    fit: Fit, effect: PlacedEffect, batches: Sequence[Batch], settings: SearchSettings
) -> tuple[System, System]:
    """Return the systems with and without the effect, which do not differ by the noise of the lines they are fitted to.

    The other parameters are fitted anew where the effect takes much off chi-square and time is left.
    """
    gain = effect_wald_statistic(fit, effect)[0]
    if gain < settings.selection.strong_gain or settings.fit.is_over:
        return fit.system(), fit.model.system(theta_without(fit, effect))
    some, steps = select_every_nth_line(batches, settings.fit.target_lines), settings.worth.refit_steps
    few = replace(settings.fit, search_rounds=settings.worth.refit_rounds, search_steps=steps)
    lacking = fit_until_stable(_best_start(fit, effect, some), SearchLines(some, some), few)
    same = take_steps(fit, add_model_error(some, lacking.shares), steps, settings.fit)
    return fit.model.system(same.theta), lacking.system()


def _best_start(fit: Fit, effect: PlacedEffect, batches: Sequence[Batch]) -> Estimate:
    """The model without the effect, its other parameters as they are or to first order, whichever fits better."""
    lacking = extend_model(fit, without_effect(fit.geometry, effect))
    shifted = extend_model(fit.model.at(theta_without(fit, effect)), lacking.geometry)
    return min(lacking, shifted, key=lambda start: penalized_chi2(start, batches))


def theta_without(fit: Fit, effect: PlacedEffect) -> Array:
    """Return the parameters (p,) with the effect at its null and the others fitted to the data, to first order."""
    parameters, information = fit.model.parameters, fit.minimum.total.information
    free = np.flatnonzero(parameters.free)
    items = parameters_of_interest(effect.parameters)
    null = {parameters.index(effect.full_name(item)): item.fitted_null for item in items}
    own = {parameters.index(effect.full_name(item)) for item in effect.parameters}
    tested = np.array([i for i, index in enumerate(free) if index in null], np.intp)
    others = np.array([i for i, index in enumerate(free) if index not in own], np.intp)
    change = np.array([null[free[i]] - fit.theta[free[i]] for i in tested])
    covariance = covariance_from_information(information[np.ix_(others, others)])
    theta = fit.theta.copy()
    theta[free[others]] -= covariance @ (information[np.ix_(others, tested)] @ change)
    theta = limit_to_bounds(parameters, fit.theta, theta)
    theta[list(null)] = list(null.values())
    return np.asarray(theta)


def _swept_components(batches: Sequence[Batch]) -> list[str]:
    """Names of the loads that the sweeps apply."""
    applied = [np.unique(batch.lines.components) for batch in batches if not batch.is_static]
    return [COMPONENTS[j] for j in sorted({int(j) for part in applied for j in part})]


def _harmonics(fit: Fit, batches: Sequence[Batch], settings: WorthSettings) -> _Harmonics | None:
    """The harmonics of the rotor speed within the swept band; None where there are none, or too few channels."""
    rotor, sweeps = fit.geometry.rotor, [batch for batch in batches if not batch.is_static]
    speed = rotor.speed if rotor else max((batch.spin for batch in sweeps), default=0.0)
    highest = max((float(batch.frequency[-1]) for batch in sweeps), default=0.0)
    frequency = np.asarray(speed * np.arange(1.0, settings.harmonics + 1.0), float)
    frequency = frequency[(frequency > 0) & (frequency <= highest)]
    if not len(frequency):
        return None
    levels = np.zeros(6)
    for batch in sweeps:
        for run in range(len(batch.runs)):
            lines = batch.lines.run == run
            power = np.sum(np.abs(batch.lines.loads[lines]) ** 2, axis=0) / 2.0
            np.maximum.at(levels, batch.lines.components[lines][:1].ravel(), np.sqrt(power))
    components = np.flatnonzero(levels)
    variance = np.array([_channel_variance(sweeps, f) for f in frequency])
    if np.any(np.isfinite(variance).sum(axis=1) < len(components)):
        return None
    return _Harmonics(speed, frequency, variance, components, levels[components])


def _channel_variance(sweeps: Sequence[Batch], frequency: float) -> Array:
    """Variance (c,) of each channel in the line nearest to a frequency; infinite where it is in no such line."""
    nearest = min(sweeps, key=lambda batch: float(np.abs(batch.line_frequency - frequency).min()))
    precision = nearest.lines.channel_precision[np.argmin(np.abs(nearest.line_frequency - frequency))]
    return np.where(precision > 0, 1.0 / np.where(precision > 0, precision, 1.0), np.inf)


def _worth(fit: Fit, whole: System, lacking: System, harmonics: _Harmonics) -> dict[str, float]:
    system, swept = fit.system(), harmonics.components
    solution = solve(system, harmonics.frequency, harmonics.spin)
    T, T0 = (response(item, solve(item, harmonics.frequency, harmonics.spin))[:, :, swept] for item in (whole, lacking))
    weight = 1.0 / harmonics.variance
    G, noise = _weighted_inverse(response(system, solution)[:, :, swept], weight)
    reduced = _weighted_inverse(T0, weight)[0] @ T
    change = np.abs(reduced - np.eye(len(swept))) * harmonics.levels
    variance = noise[:, :, None] + _parameter_variance(fit, system, solution, G, harmonics)
    worth = np.max(change / np.sqrt(variance), axis=(0, 2))
    return {COMPONENTS[j]: float(value) for j, value in zip(swept, worth, strict=True)}


def _weighted_inverse(T: ComplexArray, weight: Array) -> tuple[ComplexArray, Array]:
    """G (h, u, c) for responses T (h, c, u) and weights (h, c), and the variance (h, u) of the loads by noise."""
    weighted = T.conj().swapaxes(1, 2) * weight[:, None, :]
    inverse = np.linalg.inv(weighted @ T)
    return np.asarray(inverse @ weighted), np.real(np.diagonal(inverse, axis1=1, axis2=2))


def _parameter_variance(fit: Fit, system: System, solution: Solution, G: ComplexArray, harmonics: _Harmonics) -> Array:
    """Variance (h, u, u) of each load, by applied load, that the covariance of the parameters makes."""
    covariance = covariance_from_information(fit.minimum.total.information)
    index, variance = np.arange(len(harmonics.frequency)), []
    for j, level in zip(harmonics.components, harmonics.levels, strict=True):
        loads = np.zeros((len(index), 6), complex)
        loads[:, j] = level
        change = G @ output_jacobian(system, solution, index, loads)
        variance.append(np.real(np.einsum("hip,pq,hiq->hi", change, covariance, change.conj())))
    return np.asarray(np.maximum(np.stack(variance, axis=2), 0.0))
