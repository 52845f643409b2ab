"""Effects that the given runs cannot show, and the reason."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.result import Trial, UntestableEffect
from balance_cli.diagnosis.search.score_statistics import Score
from balance_cli.diagnosis.settings import SelectionSettings
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.model import effects
from balance_cli.model.effects import Effect


def find_untestable_effects(
    scores: Sequence[Score],
    trials: Sequence[Trial],
    spectra: Spectra,
    geometry: Geometry,
    settings: SelectionSettings,
) -> tuple[UntestableEffect, ...]:
    """Return each effect that has no place in the rig, or that cannot show at any of its places.

    Empirical effects are left out, and those that the runs have shown: the effects of the updated `geometry`, and those
    with a significant trial, which an unexplained residual can hide from the last `scores`.
    """
    present = {item.name for item in geometry.effects}
    present |= {trial.effect_name for trial in trials if trial.p_value < settings.significance_level}
    untestable = []
    for effect in effects.EFFECTS:
        expected = [score.expected for score in scores if score.candidate.effect.name == effect.name]
        if effect.empirical or effect.name in present:
            continue
        if not effect.places(geometry):
            untestable.append(UntestableEffect(effect.name, _no_place_reason(geometry)))
        elif effect.search.tone is not None and not _has_tone_lines(effect, spectra, geometry):
            untestable.append(UntestableEffect(effect.name, _no_tone_lines_reason(effect, spectra, geometry)))
        elif expected and max(expected) < settings.detectable_chi2:
            reason = _untestable_reason(effect, max(expected), spectra, settings)
            untestable.append(UntestableEffect(effect.name, reason))
    return tuple(untestable)


def _no_place_reason(geometry: Geometry) -> str:
    cells, channels = (len(items) for items in (geometry.cells, geometry.channels))
    counted = f"{cells} cell{'s' * (cells != 1)}, {channels} channel{'s' * (channels != 1)}"
    return f"a rig with {counted} that moves in {', '.join(geometry.freedom)} has no place for it"


def _tone_frequencies(effect: Effect, geometry: Geometry) -> tuple[float, ...]:
    """The frequencies [Hz] from which the tone of an effect is searched."""
    assert effect.search.tone is not None and effect.search.starts is not None
    name = effect.search.tone.frequency
    return tuple(start[name] for start in effect.search.starts(geometry, effect.places(geometry)[0]))


def _has_tone_lines(effect: Effect, spectra: Spectra, geometry: Geometry) -> bool:
    """Whether a run has a line whose bin is beside one of the tone's frequencies; others show its leakage only."""
    return any(
        np.min(np.abs(run.frequency - tone)) <= 1.5 * np.min(np.diff(np.unique(run.frequency)))
        for run in spectra.lines
        if len(np.unique(run.frequency)) > 1
        for tone in _tone_frequencies(effect, geometry)
    )


def _no_tone_lines_reason(effect: Effect, spectra: Spectra, geometry: Geometry) -> str:
    tones = " or ".join(f"{tone:g}" for tone in _tone_frequencies(effect, geometry))
    moving = np.concatenate([run.frequency[run.frequency > 0] for run in spectra.lines])
    return f"no line of the sweeps ({moving.min():.3g} to {moving.max():.3g} Hz) is at {tones} Hz"


def _untestable_reason(effect: Effect, expected: float, spectra: Spectra, settings: SelectionSettings) -> str:
    if expected >= settings.invisible_chi2:
        return f"a change that matters would change chi-square by only {expected:.1g}"
    if effect.needs_spin and not any(run.rotor_speed for run in spectra.lines):
        return "all runs were recorded at rest; it needs sweeps with the rotor turning"
    if effect.needs_mean and not any((run.frequency == 0).any() for run in spectra.lines):
        return "no record has a mean that a channel measures"
    measurement = effect.separated_by[0].lower() + effect.separated_by[1:]
    return f"in these runs the fitted parameters describe it as well; what would show it: {measurement}"
