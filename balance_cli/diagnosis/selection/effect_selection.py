"""What of a closed model is needed: each effect's evidence, what can go, and what cannot be believed."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import DeclaredEffect, Geometry
from balance_cli.diagnosis.result import Trial
from balance_cli.diagnosis.search.candidates import candidate_at, parameters_of_interest, smaller_places
from balance_cli.diagnosis.search.score_statistics import extend_model
from balance_cli.diagnosis.selection.confirm import (
    MIN_EFFECT_SHARE,
    SIGNIFICANCE_LEVEL,
    STRONG_GAIN,
    bonferroni_p_value,
)
from balance_cli.diagnosis.selection.effect_statistics import effect_wald_statistic, wald_statistic
from balance_cli.diagnosis.selection.fit import Fit, fit_all_lines, unexplained_chi2
from balance_cli.estimation.measurements import Batch
from balance_cli.model.balance import BalanceModel
from balance_cli.model.effects import Where
from balance_cli.model.placed_effects import PlacedEffect, declared_effects

Array = NDArray[np.float64]

# Probability beyond which a motion of an effect is as well left out.
NEGLIGIBLE_P_VALUE = 1e-3


def refit_without_effect(fit: Fit, one: PlacedEffect, batches: Sequence[Batch]) -> Fit:
    """The model without an effect, refitted."""
    model, theta = extend_model(fit.model, fit.theta, without_effect(fit.model.geometry, one))
    return fit_all_lines(model, theta, batches)


def keep_effects(
    labels: Collection[str], geometry: Geometry, model: BalanceModel, theta: Array
) -> tuple[BalanceModel, Array]:
    """A model with those effects of a geometry that have these labels, its other parameters as they are in `theta`."""
    kept = [
        item
        for item, one in zip(geometry.effects, _effects_in_declared_order(geometry), strict=True)
        if one.label in labels
    ]
    return extend_model(model, theta, geometry.model_copy(update={"effects": tuple(kept)}))


def without_effect(geometry: Geometry, one: PlacedEffect) -> Geometry:
    """The geometry without an effect."""
    kept = [
        item
        for item, placed in zip(geometry.effects, _effects_in_declared_order(geometry), strict=True)
        if placed.label != one.label
    ]
    return geometry.model_copy(update={"effects": tuple(kept)})


def _effects_in_declared_order(geometry: Geometry) -> list[PlacedEffect]:
    """Placed effects in the order in which the geometry declares them."""
    return [declared_effects(geometry.model_copy(update={"effects": (item,)}))[0] for item in geometry.effects]


def prune_effects(fit: Fit, batches: Sequence[Batch], count: int, number: int) -> tuple[Fit, tuple[Trial, ...]]:
    """The model without effects, and without motions of effects, that later ones have made needless."""
    trials: list[Trial] = []
    for one in sorted(declared_effects(fit.model.geometry), key=lambda item: effect_wald_statistic(fit, item)[0]):
        gain, known = effect_wald_statistic(fit, one)
        if gain < STRONG_GAIN and bonferroni_p_value(gain, max(known, 1), count) >= SIGNIFICANCE_LEVEL:
            less = refit_without_effect(fit, one, batches)
            if bonferroni_p_value(less.chi2 - fit.chi2, max(known, 1), count) >= SIGNIFICANCE_LEVEL:
                why = "later effects have made it needless"
                trials.append(_removal_trial(number, one, known, less.chi2 - fit.chi2, why))
                fit = less
                continue
        fit, smaller = _narrow_place(fit, one, batches, number)
        trials += smaller
    return fit, tuple(trials)


def drop_unsupported_effects(
    fit: Fit, batches: Sequence[Batch], noise_alone: bool, certain_labels: Collection[str], number: int
) -> tuple[Fit, tuple[Trial, ...]]:
    """The model without effects that are worth little beside all that no effect explains: that could look like them.

    Where the weights carry a model error, little is less than all; the labels in `sure` are not in question.
    """
    trials: list[Trial] = []
    share = MIN_EFFECT_SHARE if noise_alone else 1.0
    while least := share * unexplained_chi2(fit, batches, noise_alone):
        open_ones = [one for one in declared_effects(fit.model.geometry) if one.label not in certain_labels]
        if not open_ones:
            break
        weak = [
            (one, refit_without_effect(fit, one, batches))
            for one in open_ones
            if effect_wald_statistic(fit, one)[0] < least
        ]
        one, less = min(weak, key=lambda item: item[1].chi2, default=(None, fit))
        gain = less.chi2 - fit.chi2
        if one is None or gain >= least:
            break
        why, known = "what no effect explains is larger and could look like it", effect_wald_statistic(fit, one)[1]
        trials.append(_removal_trial(number, one, known, gain, why))
        fit = less
    return fit, tuple(trials)


def _removal_trial(number: int, one: PlacedEffect, known: int, gain: float, why: str) -> Trial:
    return Trial(number, one.label, gain, known, 1.0, gain, "removed", why)


def _narrow_place(fit: Fit, one: PlacedEffect, batches: Sequence[Batch], number: int) -> tuple[Fit, list[Trial]]:
    """The effect at a smaller place, as long as nothing is lost by it."""
    trials: list[Trial] = []
    while True:
        choices = [(where, *_lost_chi2(fit, one, where)) for where in smaller_places(one, fit.model.geometry)]
        choices = [item for item in choices if bonferroni_p_value(item[1], max(item[2], 1), 1) > NEGLIGIBLE_P_VALUE]
        if not choices:
            return fit, trials
        where, _, known = min(choices, key=lambda item: item[1])
        less, smaller = _refit_at_place(fit, one, where, batches)
        if bonferroni_p_value(less.chi2 - fit.chi2, max(known, 1), 1) <= NEGLIGIBLE_P_VALUE:
            return fit, trials
        why = f"nothing is lost at {smaller.label}"
        trials.append(Trial(number, one.label, less.chi2 - fit.chi2, known, 1.0, less.chi2 - fit.chi2, "narrowed", why))
        fit, one = less, smaller


def _lost_chi2(fit: Fit, one: PlacedEffect, where: Where) -> tuple[float, int]:
    """Wald's chi-square of the parameters that the smaller place does not have."""
    kept = {item.name for item in candidate_at(one.effect.name, where, fit.model.geometry).one.parameters}
    gone = [item for item in parameters_of_interest(one.parameters) if item.name not in kept]
    return wald_statistic(fit, [one.full_name(item) for item in gone], [item.fitted_null for item in gone])


def _refit_at_place(fit: Fit, one: PlacedEffect, where: Where, batches: Sequence[Batch]) -> tuple[Fit, PlacedEffect]:
    """The same effect at another place, refitted from the same values."""
    geometry = fit.model.geometry
    smaller = candidate_at(one.effect.name, where, geometry).one
    known = {item.name for item in smaller.parameters}
    effects = tuple(
        DeclaredEffect(name=item.name, where=where, parameters={k: v for k, v in item.parameters.items() if k in known})
        if placed.label == one.label
        else item
        for item, placed in zip(geometry.effects, _effects_in_declared_order(geometry), strict=True)
    )
    model, theta = extend_model(fit.model, fit.theta, geometry.model_copy(update={"effects": effects}))
    for item in smaller.parameters:
        was = one.full_name(item)
        theta[model.parameters.index(smaller.full_name(item))] = fit.theta[fit.model.parameters.index(was)]
    return fit_all_lines(model, theta, batches), smaller
