"""Effect selection: remove the effects of an updated model that are not needed, and those that are not supported."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import DeclaredEffect, Geometry
from balance_cli.diagnosis.fit_settings import FitSettings
from balance_cli.diagnosis.result import Trial
from balance_cli.diagnosis.search.candidates import candidate_at, parameters_of_interest, smaller_places
from balance_cli.diagnosis.search.extended_models import extend_model
from balance_cli.diagnosis.search.trials import refit_trial
from balance_cli.diagnosis.selection.effect_statistics import (
    effect_wald_statistic,
    shape_parameter_count,
    wald_statistic,
)
from balance_cli.diagnosis.selection.fit import Fit, ReducedFit, fit_all_lines, fit_contenders, unexplained_chi2
from balance_cli.diagnosis.selection.mains_frequency import frequency_looks, independent_gain
from balance_cli.diagnosis.selection.selection_task import SelectionTask
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.diagnosis.significance import bonferroni_p_value
from balance_cli.estimation.batch import Batch
from balance_cli.model.balance import Estimate
from balance_cli.model.effects import Where
from balance_cli.model.placed_effects import PlacedEffect, declared_effects

Array = NDArray[np.float64]

REASON_NOT_NEEDED = "later effects have made it needless"
REASON_NOT_SUPPORTED = "what no effect explains is larger and could look like it"


def refit_without_effect(fit: Fit, effect: PlacedEffect, batches: Sequence[Batch], settings: FitSettings) -> Fit:
    """Return the refit of the model without an effect, made once for each fit."""
    known = fit.reduced.get(effect.label)
    if known is not None and known.is_of(batches, settings):
        return known.fit
    reduced = fit_all_lines(extend_model(fit, without_effect(fit.geometry, effect)), batches, settings)
    fit.reduced[effect.label] = ReducedFit(reduced, tuple(batches), settings)
    return reduced


def keep_effects(labels: Collection[str], geometry: Geometry, estimate: Estimate) -> Estimate:
    """Return a model with those effects of a geometry that have these labels, at the values of an estimate."""
    effects = tuple(item for item, placed in _declared_and_placed(geometry) if placed.label in labels)
    return extend_model(estimate, geometry.model_copy(update={"effects": effects}))


def without_effect(geometry: Geometry, effect: PlacedEffect) -> Geometry:
    """Return the geometry without an effect."""
    effects = tuple(item for item, placed in _declared_and_placed(geometry) if placed.label != effect.label)
    return geometry.model_copy(update={"effects": effects})


def _declared_and_placed(geometry: Geometry) -> list[tuple[DeclaredEffect, PlacedEffect]]:
    """The effects that a geometry declares, in its order, each with its place."""
    return [(item, declared_effects(geometry.model_copy(update={"effects": (item,)}))[0]) for item in geometry.effects]


def select_effects(fit: Fit, task: SelectionTask, count: int, number: int) -> tuple[Fit, tuple[Trial, ...]]:
    """Return the model without effects that are not needed, of `count` candidates, and without unsupported ones.

    What an effect without support had taken from the others may have been all that a further one corrected: needless
    effects are looked for once more where one was removed.
    """
    fit, needless = prune_effects(fit, task, count, number)
    fit, dropped = drop_unsupported_effects(fit, task, number)
    if not dropped:
        return fit, needless
    fit, later = prune_effects(fit, task, count, number)
    return fit, (*needless, *dropped, *later)


# ---- effects that are not needed -------------------------------------------------------------------------------------


def prune_effects(fit: Fit, task: SelectionTask, count: int, number: int) -> tuple[Fit, tuple[Trial, ...]]:
    """Return the model without effects, and without motions of effects, that others have made unnecessary.

    Once the time is over, Wald's statistic decides, a few steps take the others to where they then
    belong, and no place is narrowed: what chance explains is never left in.

    A shape of several parameters adapts to the noise, so that these count as well (Davies, Biometrika 64 (1977)
    247: the supremum over parameters that are unidentifiable at the null).
    """
    batches, settings = task.batches, task.settings
    limits, trials = settings.selection, list[Trial]()
    for effect in sorted(declared_effects(fit.geometry), key=lambda item: effect_wald_statistic(fit, item)[0]):
        over = task.announce(f"need of {effect.label}")
        gain, parameters = effect_wald_statistic(fit, effect)
        fitted = max(parameters, 1) + shape_parameter_count(fit, effect)
        tests = count * frequency_looks(fit, effect, batches, settings)
        independent = independent_gain(gain, fit, effect, batches)
        weak = gain < limits.strong_gain
        if weak and bonferroni_p_value(independent, fitted, tests) >= limits.significance_level:
            reduced = refit_without_effect(fit, effect, batches, settings.fit)
            lost = reduced.chi2 - fit.chi2
            independent = independent_gain(lost, fit, effect, batches)
            if over or bonferroni_p_value(independent, fitted, tests) >= limits.significance_level:
                trials.append(_removal_trial(number, effect, parameters, lost, REASON_NOT_NEEDED))
                fit = reduced
                continue
        if not over:
            fit, narrowed = _narrow_place(fit, effect, batches, number, settings)
            trials += narrowed
    return fit, tuple(trials)


def _removal_trial(number: int, effect: PlacedEffect, parameters: int, gain: float, reason: str) -> Trial:
    return refit_trial(number, effect.label, gain, "removed", reason, parameters, score=gain)


def narrow_places(
    fit: Fit, batches: Sequence[Batch], number: int, settings: SearchSettings
) -> tuple[Fit, tuple[Trial, ...]]:
    """Return the model with each effect at the smallest place that describes the data as well."""
    trials: list[Trial] = []
    for effect in declared_effects(fit.geometry):
        if settings.fit.is_over:
            break
        fit, narrowed = _narrow_place(fit, effect, batches, number, settings)
        trials += narrowed
    return fit, tuple(trials)


def _narrow_place(
    fit: Fit, effect: PlacedEffect, batches: Sequence[Batch], number: int, settings: SearchSettings
) -> tuple[Fit, list[Trial]]:
    """The effect at a smaller place, as long as chi-square does not rise significantly.

    All motions that Wald's statistic finds needless are removed at once: a fit with several of them follows the valleys
    of their shapes for long. Only where that loses something they are removed one by one.
    """
    trials, at_once = list[Trial](), True
    while True:
        where = _smallest_place(fit, effect, settings) if at_once else None
        where = where or _next_smaller_place(fit, effect, settings)
        if where is None:
            return fit, trials
        parameters = _lost_chi2(fit, effect, where)[1]
        reduced, smaller = _refit_at_place(fit, effect, where, batches, settings.fit)
        loss = reduced.chi2 - fit.chi2
        if not _is_negligible(loss, parameters, settings):
            if at_once and len(effect.where) - len(where) > 1:
                at_once = False
                continue
            return fit, trials
        trials.append(_narrowing_trial(number, effect, smaller, parameters, loss))
        fit, effect = reduced, smaller


def _smallest_place(fit: Fit, effect: PlacedEffect, settings: SearchSettings) -> Where | None:
    """The smallest place without which Wald's statistic finds nothing lost, by removing one name after another."""
    smallest, place = None, effect
    while where := _next_smaller_place(fit, place, settings, whole=effect):
        smallest, place = where, candidate_at(effect.effect.name, where, fit.geometry).placed_effect
    return smallest


def _next_smaller_place(
    fit: Fit, effect: PlacedEffect, settings: SearchSettings, whole: PlacedEffect | None = None
) -> Where | None:
    """The place with one name less that loses least, if that is negligible; the loss is that of the `whole` effect."""
    fitted = effect if whole is None else whole
    choices = [(where, *_lost_chi2(fit, fitted, where)) for where in smaller_places(effect, fit.geometry)]
    choices = [item for item in choices if _is_negligible(item[1], item[2], settings)]
    return min(choices, key=lambda item: item[1])[0] if choices else None


def _is_negligible(loss: float, parameters: int, settings: SearchSettings) -> bool:
    """Whether chance explains a loss of chi-square with this number of parameters; one place is one test."""
    return bonferroni_p_value(loss, max(parameters, 1), 1) > settings.selection.negligible_p_value


def _narrowing_trial(number: int, effect: PlacedEffect, smaller: PlacedEffect, parameters: int, loss: float) -> Trial:
    reason = f"nothing is lost at {smaller.label}"
    return refit_trial(number, effect.label, loss, "narrowed", reason, parameters, score=loss)


def _lost_chi2(fit: Fit, effect: PlacedEffect, where: Where) -> tuple[float, int]:
    """Wald's chi-square of the parameters that the smaller place does not have, and how many are identifiable."""
    remaining = {item.name for item in candidate_at(effect.effect.name, where, fit.geometry).placed_effect.parameters}
    lost = [item for item in parameters_of_interest(effect.parameters) if item.name not in remaining]
    return wald_statistic(fit, [effect.full_name(item) for item in lost], [item.fitted_null for item in lost])


def _refit_at_place(
    fit: Fit, effect: PlacedEffect, where: Where, batches: Sequence[Batch], settings: FitSettings
) -> tuple[Fit, PlacedEffect]:
    """The same effect at another place, refitted from the same values."""
    geometry = fit.geometry
    moved = candidate_at(effect.effect.name, where, geometry).placed_effect
    names = {item.name for item in moved.parameters}
    effects = tuple(
        DeclaredEffect(name=item.name, where=where, parameters={k: v for k, v in item.parameters.items() if k in names})
        if placed.label == effect.label
        else item
        for item, placed in _declared_and_placed(geometry)
    )
    start = extend_model(fit, geometry.model_copy(update={"effects": effects}))
    for item in moved.parameters:
        value = fit.theta[fit.model.parameters.index(effect.full_name(item))]
        start.theta[start.model.parameters.index(moved.full_name(item))] = value
    return fit_all_lines(start, batches, settings), moved


# ---- effects that are not supported ----------------------------------------------------------------------------------


def drop_unsupported_effects(fit: Fit, task: SelectionTask, number: int) -> tuple[Fit, tuple[Trial, ...]]:
    """Return the model without effects whose gain is small beside the chi-square that no effect explains.

    What is unexplained could look like them. Where the weights of runs carry a model error, an effect must gain more
    than all of it. Certain effects stay. So do the others, once the time is over: only a refit can tell what is lost
    without one.
    """
    batches, settings, trials = task.batches, task.settings, list[Trial]()
    share = 1.0 if task.error_runs else settings.selection.min_effect_share
    while threshold := share * unexplained_chi2(fit, batches, task.error_runs, settings.fit):
        weak = [
            effect
            for effect in declared_effects(fit.geometry)
            if effect.label not in task.certain_labels and effect_wald_statistic(fit, effect)[0] < threshold
        ]
        if weak and task.announce(f"support of {len(weak)} effects"):
            break
        refits = _refit_without_each(fit, weak, batches, fit.chi2 + threshold, settings.fit)
        effect, reduced = min(zip(weak, refits, strict=True), key=lambda item: item[1].chi2, default=(None, fit))
        gain = reduced.chi2 - fit.chi2
        if effect is None or gain >= threshold:
            break
        parameters = effect_wald_statistic(fit, effect)[1]
        trials.append(_removal_trial(number, effect, parameters, gain, REASON_NOT_SUPPORTED))
        fit = reduced
    return fit, tuple(trials)


def _refit_without_each(
    fit: Fit, effects: Sequence[PlacedEffect], batches: Sequence[Batch], limit: float, settings: FitSettings
) -> list[Fit]:
    """The refits without each of the effects; those that stay above `limit` or the best one are not finished."""
    known = {effect.label: fit.reduced.get(effect.label) for effect in effects}
    refits = {label: item.fit for label, item in known.items() if item is not None and item.is_of(batches, settings)}
    others = [effect for effect in effects if effect.label not in refits]
    starts = [extend_model(fit, without_effect(fit.geometry, effect)) for effect in others]
    limit = min([limit, *(item.chi2 for item in refits.values())])
    for effect, refit in zip(others, fit_contenders(starts, batches, limit, 0.0, settings), strict=True):
        refits[effect.label] = refit
        if refit.minimum.converged:
            fit.reduced[effect.label] = ReducedFit(refit, tuple(batches), settings)
    return [refits[effect.label] for effect in effects]
