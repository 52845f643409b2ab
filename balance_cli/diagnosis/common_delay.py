"""An effect of all channels that may be one of the exciters' loads, or the reverse, which the runs do not tell apart.

The sweeps compare channels with loads. Channels that are all early and loads that are all late have one response, but
only the channels turn the harmonics of wind-on loads. So the update describes the data, and does not tell the cause.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from balance_cli.diagnosis.alike_effects import alike_in_all
from balance_cli.diagnosis.result import EXPLAINED, PARTLY_EXPLAINED, Diagnosis
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.model.effects.places import acts_on_loads
from balance_cli.model.placed_effects import place_effect


def judge_common_delay(
    diagnosis: Diagnosis, updated: IdentifiedModel, swept: Collection[str] | None = None
) -> tuple[Diagnosis, IdentifiedModel]:
    """Return diagnosis and updated model of which an effect of all channels is no explanation, but a doubt.

    The loads then have in sigma what they differ by if the other is the cause: by the variance of its parameters in the
    updated model, which contains their squares, or, of an effect of loads, by a lag that the channels may have. `swept`
    are the components that sweeps applied (None: all): the delay of the only one may be that of the channels.
    """
    names, covariance = list(updated.parameters.names), updated.covariance.copy()
    channels_may_lag, notes = updated.channels_may_lag, []
    is_good = diagnosis.verdict == EXPLAINED
    for effect in diagnosis.effects:
        placed = place_effect(effect.name, effect.where, updated.geometry)
        alike = alike_in_all(placed, updated.geometry, is_good, swept)
        if alike is None or effect.is_of_no_consequence:
            continue
        if acts_on_loads(placed.effect.places, updated.geometry):
            channels_may_lag = True
        else:
            for parameter in placed.parameters:
                place = names.index(placed.full_name(parameter))
                covariance[place, place] += (updated.parameters.value[place] / updated.misfit_scale) ** 2
        notes.append(
            f"{effect.label} may as well be {alike.label}, which these runs do not tell: sigma of loads by the updated "
            f"model contains the difference. {alike.separated_by}"
        )
    if not notes:
        return diagnosis, updated
    verdict = PARTLY_EXPLAINED if diagnosis.verdict == EXPLAINED else diagnosis.verdict
    judged = replace(diagnosis, verdict=verdict, notes=(*diagnosis.notes, *notes))
    return judged, replace(updated, covariance=covariance, channels_may_lag=channels_may_lag)
