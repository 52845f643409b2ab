"""How many causes the effects of a diagnosis have: enough effects describe any data, and one box many channels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.diagnosis.result import EXPLAINED, PARTLY_EXPLAINED, Diagnosis, FoundEffect
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS, SelectionSettings
from balance_cli.model.effects import EFFECTS


def judge_number_of_causes(diagnosis: Diagnosis) -> Diagnosis:
    """Return the diagnosis, explained in part where it needs more causes at once than are likely.

    Enough effects describe any data: six that were not there explained a damped cell before the library had its effect.
    A note says which channels have the same fault with one value.
    """
    settings = (diagnosis.settings or DEFAULT_SETTINGS).selection
    shared = [group for group in equal_effects(diagnosis.effects, settings) if len(group) > 1]
    if shared:
        diagnosis = replace(diagnosis, notes=(*diagnosis.notes, *map(_describe_shared, shared)))
    count = count_causes(diagnosis.effects, settings)
    if diagnosis.verdict != EXPLAINED or count <= settings.max_causes:
        return diagnosis
    note = (
        f"{count} causes at once describe these data; one that no effect of the library describes is likelier. Look "
        "for each of them at the rig before the updated model is used"
    )
    return replace(diagnosis, notes=(*diagnosis.notes, note), verdict=PARTLY_EXPLAINED)


def _describe_shared(group: Sequence[FoundEffect]) -> str:
    places = ", ".join(effect.where[0] for effect in group)
    return (
        f"{group[0].name} is the same in {places}: one cause, a data-acquisition box that they share? Declare it as a "
        "group of `acquisition.groups`, and it is fitted as one"
    )


def count_causes(effects: Sequence[FoundEffect], settings: SelectionSettings) -> int:
    """Return the number of causes of these effects.

    Readings without load, which are everyday, and effects of no consequence are none; what an effect does to several
    load components, each of which has an exciter like the others, is one, and so is what it does to several channels
    with one value.
    """
    everyday = {effect.name for effect in EFFECTS if effect.is_zero_reading}
    counted = [effect for effect in effects if effect.name not in everyday and not effect.is_of_no_consequence]
    at_loads = {effect.name for effect in counted if _is_at_loads(effect)}
    return len(at_loads) + len(equal_effects([effect for effect in counted if effect.name not in at_loads], settings))


def equal_effects(effects: Sequence[FoundEffect], settings: SelectionSettings) -> list[list[FoundEffect]]:
    """Return the effects in groups: those of several places with one parameter of the same value, the others alone."""
    comparable = [effect for effect in effects if len(effect.where) == len(effect.parameters) == 1]
    comparable = [effect for effect in comparable if not _is_at_loads(effect)]
    groups = [[effect] for effect in effects if effect not in comparable]
    for name in dict.fromkeys(effect.name for effect in comparable):
        same = sorted((item for item in comparable if item.name == name), key=lambda item: item.parameters[0].value)
        groups.append(same[:1])
        for below, above in pairwise(same):
            if _is_equal(below, above, settings):
                groups[-1].append(above)
            else:
                groups.append([above])
    return groups


def _is_at_loads(effect: FoundEffect) -> bool:
    return bool(effect.where) and set(effect.where) <= set(COMPONENTS)


def _is_equal(first: FoundEffect, second: FoundEffect, settings: SelectionSettings) -> bool:
    (a,), (b,) = first.parameters, second.parameters
    limit = min(settings.equal_sigma * math.hypot(a.sigma, b.sigma), settings.equal_share * abs(a.value))
    return abs(a.value - b.value) <= limit
