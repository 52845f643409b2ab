"""Effects that the data need, but whose parameters they do not determine: something is there, not known to be this.

Where the band ends below a mode of a part that the model lacks, any body on a spring beside the rig lowers the residual
to its noise: a support of 5e7 kg with a standard deviation of 7e7 kg was an explanation.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from balance_cli.diagnosis.result import EXPLAINED, PARTLY_EXPLAINED, Diagnosis, FoundEffect
from balance_cli.model.fitted_effects import FittedParameter
from balance_cli.model.placed_effects import place_effect

KNOWN_TO = 2.0
"""Distance of a parameter from its null over its standard deviation, from which the data determine it."""
LARGEST_SIGMA = 100.0
"""Of the size of a change of a parameter that matters (its scale): one that is known to be small is determined. Of a
support it is ten times the mass of what moves on it."""


def judge_unidentifiable_effects(diagnosis: Diagnosis) -> Diagnosis:
    """Return the diagnosis, explained in part where an effect has a parameter that the data do not determine."""
    notes = []
    for effect in diagnosis.effects:
        names = unidentifiable_parameters(effect, diagnosis)
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


def unidentifiable_parameters(effect: FoundEffect, diagnosis: Diagnosis) -> tuple[FittedParameter, ...]:
    """Return the parameters of an effect that may be anything from nothing to far beyond the size of the rig.

    Not judged are parameters of which the reciprocal is fitted, which are infinite where they are nothing.
    """
    where = effect.where if effect.choice is None else (*effect.where, effect.choice[1])
    placed = place_effect(effect.name, where, diagnosis.geometry)
    known = {parameter.name: parameter for parameter in placed.parameters}
    unidentifiable = []
    for item in effect.parameters:
        parameter = known.get(item.name)
        if parameter is None or parameter.reciprocal or item.interval is not None:
            continue
        sigma = item.sigma if np.isfinite(item.sigma) else 0.0
        if sigma > LARGEST_SIGMA * parameter.scale and abs(item.value - parameter.null) < KNOWN_TO * sigma:
            unidentifiable.append(item)
    return tuple(unidentifiable)
