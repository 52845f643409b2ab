"""Effects of which the given runs hold nothing, and why."""

from __future__ import annotations

from collections.abc import Sequence

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.result import UntestableEffect
from balance_cli.diagnosis.search.score_statistics import Score
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.model import effects
from balance_cli.model.effects import Effect

INVISIBLE_CHI2 = 1e-3
"""Chi-square by which a change that matters is no change at all."""
DETECTABLE_CHI2 = 4.0
"""Chi-square below which a change that matters cannot be told from noise."""


def not_testable(scores: Sequence[Score], spectra: Spectra, geometry: Geometry) -> tuple[UntestableEffect, ...]:
    """Each effect that has no place in the rig, or that was a candidate and could not show at any of its places.

    The empirical ones are left out, and what the geometry has of the closed model: that has shown.
    """
    there = {item.name for item in geometry.effects}
    found = []
    for effect in effects.EFFECTS:
        expected = [score.expected for score in scores if score.candidate.effect.name == effect.name]
        if effect.empirical or effect.name in there:
            continue
        if not effect.places(geometry):
            found.append(UntestableEffect(effect.name, _no_place(geometry)))
        elif expected and max(expected) < DETECTABLE_CHI2:
            found.append(UntestableEffect(effect.name, _untestable_reason(effect, max(expected), spectra)))
    return tuple(found)


def _no_place(geometry: Geometry) -> str:
    cells, channels = (len(items) for items in (geometry.cells, geometry.channels))
    counted = f"{cells} cell{'s' * (cells != 1)}, {channels} channel{'s' * (channels != 1)}"
    return f"a rig with {counted} that moves in {', '.join(geometry.freedom)} has no place for it"


def _untestable_reason(effect: Effect, expected: float, spectra: Spectra) -> str:
    if expected >= INVISIBLE_CHI2:
        return f"a change that matters would change chi-square by {expected:.1g} only"
    if effect.needs_spin and not any(run.rotor_speed for run in spectra.lines):
        return "all runs were recorded at rest; it needs sweeps with the rotor turning"
    if effect.needs_mean and not any((run.frequency == 0).any() for run in spectra.lines):
        return "no record has a mean that a channel measures"
    would = effect.separated_by[0].lower() + effect.separated_by[1:]
    return f"no run holds anything of it that the fitted parameters do not take up; what would show it: {would}"
