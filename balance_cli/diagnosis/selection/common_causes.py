"""Common causes: one effect of a group of channels, or of all exciters, in place of the same effect in each of them."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

from balance_cli.campaign.rig.channel_groups import ALL, channel_groups
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.result import Trial
from balance_cli.diagnosis.search.extended_models import extend_model
from balance_cli.diagnosis.search.trials import refit_trial
from balance_cli.diagnosis.selection.effect_selection import without_effect
from balance_cli.diagnosis.selection.fit import Fit, fit_all_lines
from balance_cli.diagnosis.selection.selection_task import SelectionTask
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.diagnosis.significance import gain_p_value
from balance_cli.estimation.batch import Batch
from balance_cli.model.effects.places import acts_on_loads
from balance_cli.model.placed_effects import PlacedEffect, declare_effect, declared_effects, effect_label, place_effect


def merge_common_causes(fit: Fit, task: SelectionTask, number: int) -> tuple[Fit, tuple[Trial, ...]]:
    """Return the fit with groups in the place of their channels, where chi-square does not rise significantly.

    Given effects stay as they are. Large groups are tried first.
    """
    trials: tuple[Trial, ...] = ()
    for group, members in _merge_proposals(fit, task.given_labels):
        present = {effect.label for effect in declared_effects(fit.geometry)}
        if not {effect.label for effect in members} <= present:
            continue
        merged = _merge(fit, group, members, task.batches, task.settings)
        loss, saved = merged.chi2 - fit.chi2, len(members) - 1
        if gain_p_value(loss, saved) > task.settings.selection.negligible_p_value:
            trials = (*trials, *_merge_trials(number, members, effect_label(members[0].effect.name, (group,)), loss))
            fit = merged
    return fit, trials


def _merge_proposals(fit: Fit, given_labels: Collection[str]) -> Iterator[tuple[str, list[PlacedEffect]]]:
    """Groups with the effects that they could replace: the same effect in most of their channels, and in no group."""
    geometry = fit.geometry
    of_channels = channel_groups(geometry)
    effects = [effect for effect in declared_effects(geometry) if effect.label not in given_labels]
    for name in dict.fromkeys(effect.effect.name for effect in effects):
        same = [effect for effect in effects if effect.effect.name == name]
        places = same[0].effect.places
        groups = {ALL: COMPONENTS} if acts_on_loads(places, geometry) else of_channels
        possible = places(geometry)
        for group in sorted(groups, key=lambda key: -len(groups[key])):
            members = [effect for effect in same if len(effect.where) == 1 and effect.where[0] in groups[group]]
            is_new = (group,) in possible and (group,) not in {effect.where for effect in same}
            if is_new and len(members) > max(1, len(groups[group]) // 2) and _has_one_value(same[0], group, geometry):
                yield group, members


def _has_one_value(effect: PlacedEffect, group: str, geometry: Geometry) -> bool:
    """Whether a group has the parameters of each of its members: where each has its own, nothing is merged."""
    return len(effect.effect.parameters(geometry, (group,))) == len(effect.parameters)


def _merge(
    fit: Fit, group: str, members: Sequence[PlacedEffect], batches: Sequence[Batch], settings: SearchSettings
) -> Fit:
    """The refit with the effect in the group, begun at the mean of its members."""
    value = dict(zip(fit.model.parameters.names, fit.theta.tolist(), strict=True))
    geometry = fit.geometry
    for effect in members:
        geometry = without_effect(geometry, effect)
    placed = place_effect(members[0].effect.name, (group,), geometry)
    mean = {
        item.fitted_name: sum(value[effect.full_name(item)] for effect in members) / len(members)
        for item in members[0].parameters
    }
    declared = declare_effect(placed, mean)
    geometry = geometry.model_copy(update={"effects": (*geometry.effects, declared)})
    return fit_all_lines(extend_model(fit, geometry), batches, settings.fit)


def _merge_trials(number: int, members: Sequence[PlacedEffect], label: str, loss: float) -> Iterator[Trial]:
    """The trials of the members, which are removed, and of the group, which replaces them."""
    parameters, reason = len(members[0].parameters), f"{label} is one cause for all"
    yield from (refit_trial(number, effect.label, -loss, "removed", reason, parameters) for effect in members)
    yield refit_trial(number, label, -loss, "accepted", f"one cause in place of {len(members)}", parameters)
