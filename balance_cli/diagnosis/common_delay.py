"""An effect of all channels that may be one of the exciters' loads, which the runs do not tell apart.

The sweeps compare channels with loads. Channels that are all early and loads that are all late have one response, but
only the channels turn the harmonics of wind-on loads. So the update describes the data, and does not tell the cause.
"""

from __future__ import annotations

from dataclasses import replace

from balance_cli.diagnosis.conclusions import alike_in_all
from balance_cli.diagnosis.result import EXPLAINED, PARTLY_EXPLAINED, Diagnosis
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.model.placed_effects import place_effect


def judge_common_delay(diagnosis: Diagnosis, updated: IdentifiedModel) -> tuple[Diagnosis, IdentifiedModel]:
    """Return diagnosis and updated model of which an effect of all channels is no explanation, but a doubt.

    The variance of its parameters in the updated model contains their squares: the loads then have in sigma what they
    differ by if the effect is one of the exciters' loads.
    """
    names, covariance = list(updated.parameters.names), updated.covariance.copy()
    notes = []
    for effect in diagnosis.effects:
        alike = alike_in_all(place_effect(effect.name, effect.where, updated.geometry), updated.geometry)
        if alike is None or effect.is_of_no_consequence:
            continue
        for parameter in effect.parameters:
            place = names.index(f"{effect.label}.{parameter.name}")
            covariance[place, place] += parameter.value**2
        notes.append(
            f"{effect.label} may as well be {alike.label}, which these runs do not tell: sigma of loads by the updated "
            f"model contains the difference. {alike.separated_by}"
        )
    if not notes:
        return diagnosis, updated
    verdict = PARTLY_EXPLAINED if diagnosis.verdict == EXPLAINED else diagnosis.verdict
    judged = replace(diagnosis, verdict=verdict, notes=(*diagnosis.notes, *notes))
    return judged, replace(updated, covariance=covariance)
