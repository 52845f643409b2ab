"""Effects that the data need, but whose parameters they do not determine: something is there, not known to be this.

Where the band ends below a mode of a part that the model lacks, any body on a spring beside the rig lowers the residual
to its noise: a support of 5e7 kg with a standard deviation of 7e7 kg was an explanation.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from balance_cli.diagnosis.data_test_settings import UnidentifiableSettings
from balance_cli.diagnosis.result import EXPLAINED, PARTLY_EXPLAINED, Diagnosis, FoundEffect
from balance_cli.model.fitted_effects import FittedParameter
from balance_cli.model.placed_effects import place_effect


def judge_unidentifiable_effects(diagnosis: Diagnosis, settings: UnidentifiableSettings) -> Diagnosis:
    """Return the diagnosis, explained in part where an effect has a parameter that the data do not determine."""
    notes = []
    for effect in diagnosis.effects:
        names = unidentifiable_parameters(effect, diagnosis, settings)
        if names and not effect.is_of_no_consequence:
            values = ", ".join(f"{item.name} {item.value:.2g} +- {item.sigma:.2g} {item.unit}" for item in names)
            notes.append(
                f"{effect.label} lowers the residual to its noise, but these runs do not determine {values}: something "
                "acts there that need not be this effect, and its parameters are no finding. Sweep beyond the mode "
                "that it makes, or measure the part by itself"
            )
    if not notes:
        return diagnosis
    verdict = PARTLY_EXPLAINED if diagnosis.verdict == EXPLAINED else diagnosis.verdict
    return replace(diagnosis, notes=(*diagnosis.notes, *notes), verdict=verdict)


def unidentifiable_parameters(
    effect: FoundEffect, diagnosis: Diagnosis, settings: UnidentifiableSettings
) -> tuple[FittedParameter, ...]:
    """Return the parameters of an effect that may be anything from nothing to far beyond the size of the rig.

    Not judged are parameters of which the reciprocal is fitted, which are infinite where they are nothing, and those
    that are not zero without the effect, as the stiffness of a contact: one that slips all the time does not tell it.
    """
    where = effect.where if effect.choice is None else (*effect.where, effect.choice[1])
    placed = place_effect(effect.name, where, diagnosis.geometry)
    known = {parameter.name: parameter for parameter in placed.parameters}
    unidentifiable = []
    for item in effect.parameters:
        parameter = known.get(item.name)
        if parameter is None or parameter.null != 0.0 or parameter.reciprocal or item.interval is not None:
            continue
        sigma = item.sigma if np.isfinite(item.sigma) else 0.0
        is_wide = sigma > settings.largest_sigma * parameter.scale
        if is_wide and abs(item.value - parameter.null) < settings.known_to * sigma:
            unidentifiable.append(item)
    return tuple(unidentifiable)
