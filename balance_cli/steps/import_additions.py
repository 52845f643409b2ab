"""Forces at points and temperatures of an imported run."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from balance_cli.campaign.recording.additions import FORCE, TEMPERATURE, LoadPoints, RunAdditions
from balance_cli.campaign.recording.import_map import ImportMap
from balance_cli.steps.import_signals import FORCE_UNIT, TEMPERATURE_UNIT, ChannelFinder, Signal, other_signal
from balance_cli.steps.import_source import ImportedAdditions, SignalMatrix


def addition_signals(finder: ChannelFinder, mapping: ImportMap, has_loads: bool) -> dict[str, list[Signal]]:
    """The signals of each dataset that the map asks for; no forces in a run without loads."""
    signals = {}
    if mapping.load_points and has_loads:
        signals[FORCE] = [
            other_signal(finder.find(point.channel), point.name or point.channel, point, *FORCE_UNIT)
            for point in mapping.load_points
        ]
    if mapping.temperature:
        signals[TEMPERATURE] = [
            other_signal(finder.find(name), mapped.name, mapped, *TEMPERATURE_UNIT)
            for name, mapped in mapping.temperature.items()
        ]
    return signals


def additions_of(mapping: ImportMap, matrices: Mapping[str, SignalMatrix]) -> RunAdditions | None:
    """The additions whose samples these matrices hold; None where there are none."""
    if not matrices:
        return None
    points = None
    if FORCE in matrices:
        direction = np.array([point.direction for point in mapping.load_points], float)
        position = np.array([point.position for point in mapping.load_points], float)
        points = LoadPoints(matrices[FORCE].targets, direction, position)
    names = matrices[TEMPERATURE].targets if TEMPERATURE in matrices else ()
    return RunAdditions(points, names, source=ImportedAdditions(dict(matrices)))
