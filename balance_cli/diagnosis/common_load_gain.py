"""One factor between sweeps and static runs, which the search finds as a load gain of each component.

A gain of all channels that differs between static runs and records in time (a supply voltage, an amplifier's range), a
gain common to all exciters, and weights that are all off by one factor have the same response: the sweeps differ from
the static runs as a whole. Only a gain of the exciters leaves loads of wind-on runs right, which are read by channels
that the static runs have calibrated. So the update describes the data, and does not tell the cause.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.diagnosis.data_test_settings import CommonLoadGainSettings
from balance_cli.diagnosis.result import EXPLAINED, PARTLY_EXPLAINED, Diagnosis, FoundEffect
from balance_cli.estimation.identified_model import IdentifiedModel
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.model.effects import EFFECTS


@dataclass(frozen=True)
class CommonLoadGain:
    """The `components` whose load gains are one, and this `gain`, recorded over applied load."""

    components: tuple[str, ...]
    gain: float

    @property
    def error(self) -> float:
        """What loads by the channels are off by, relative, where these are the cause."""
        return abs(1.0 / self.gain - 1.0)

    @property
    def note(self) -> str:
        """The finding in one sentence."""
        names = ", ".join(self.components)
        size = f"{100.0 * self.error:.2g} %"
        return (
            f"the load gain of {names} is one factor, {self.gain:.5g}, by which sweeps and static runs differ as a "
            "whole: one cause. These runs do not show whether the exciters' loads, the weights of static runs or the "
            "channels (a supply voltage, a range) are off by it. Where it is not the exciters, loads of wind-on runs "
            f"are off by {size}, which their sigma contains with the updated model. Hang a known weight while the "
            "channels are recorded as in wind-on runs"
        )


def common_load_gain(
    effects: Sequence[FoundEffect], spectra: Spectra, settings: CommonLoadGainSettings
) -> CommonLoadGain | None:
    """Return the factor that the load gains of most swept components share; None where they differ.

    Without static runs no load gain of all components is known.
    """
    names = {effect.name for effect in EFFECTS if effect.is_load_gain}
    gains = [effect for effect in effects if effect.name in names]
    swept = {name for run in spectra.lines for name in run.components}
    if not spectra.statics or len(gains) < max(settings.min_components, len(swept) - 1):
        return None
    value = np.array([effect.parameters[0].value for effect in gains])
    sigma = np.array([effect.parameters[0].sigma or 0.0 for effect in gains])
    gain = float(np.average(value, weights=1.0 / np.maximum(sigma, np.finfo(float).tiny) ** 2))
    spread = np.maximum(settings.max_spread * abs(gain - 1.0), settings.max_sigma * sigma)
    if np.any(np.abs(value - gain) > spread):
        return None
    components = {name for effect in gains for name in effect.where}
    return CommonLoadGain(tuple(name for name in COMPONENTS if name in components), gain)


def judge_common_load_gain(
    diagnosis: Diagnosis, updated: IdentifiedModel, spectra: Spectra, settings: CommonLoadGainSettings
) -> tuple[Diagnosis, IdentifiedModel]:
    """Return diagnosis and updated model of which one common load gain is no explanation, but a doubt of all loads."""
    common = common_load_gain(diagnosis.effects, spectra, settings)
    if common is None:
        return diagnosis, updated
    verdict = PARTLY_EXPLAINED if diagnosis.verdict == EXPLAINED else diagnosis.verdict
    judged = replace(diagnosis, verdict=verdict, notes=(*diagnosis.notes, common.note))
    return judged, replace(updated, gain_error=common.error)
