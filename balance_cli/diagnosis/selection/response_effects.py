"""Effects that measured frequency responses cannot show, which a diagnosis with them leaves out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.result import UntestableEffect
from balance_cli.diagnosis.settings import SearchSettings
from balance_cli.estimation.measured_responses import NO_SAMPLES, effects_of_samples
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.io.errors import UserError


def settings_for_responses(spectra: Spectra, settings: SearchSettings) -> SearchSettings:
    """Return the settings of a search without the effects that need samples, where responses are among the spectra.

    Raises UserError where one of them is suspected.
    """
    if not spectra.responses:
        return settings
    names = effects_of_samples()
    for word in settings.suspected:
        if word.partition("@")[0] in names:
            remedy = "Leave it out, or give the runs in place of the responses"
            raise UserError(f"`{word}` cannot be tested: {NO_SAMPLES}", place="--suspect", remedy=remedy)
    return replace(settings, excluded=(*settings.excluded, *names))


def untestable_by_responses(
    spectra: Spectra, geometry: Geometry, known: Sequence[UntestableEffect]
) -> tuple[UntestableEffect, ...]:
    """Return the effects that were left out because responses are among the spectra, without those of the geometry.

    Those that are `known` to be untestable for another reason are not repeated.
    """
    names = effects_of_samples() if spectra.responses else ()
    stated = {item.name for item in geometry.effects} | {item.name for item in known}
    return tuple(UntestableEffect(name, NO_SAMPLES) for name in names if name not in stated)
