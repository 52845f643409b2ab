"""Noise of the channels near half the sample rate, of wind runs against runs with known loads.

Wind-on, no load is known: a factor in all channels, or another filter in all of them, makes loads that are possible.
But gain and filter also change the noise of sensors and amplifiers before them, which in sound runs is the same. Noise
that arises behind them shows neither.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.diagnosis.consistency.findings import NOISE_LEVEL, WARNING, ConsistencyFinding
from balance_cli.signals.nyquist_noise import (
    KINDS_WITH_KNOWN_LOADS,
    RunNoise,
    UsualNoise,
    measure_nyquist_noise,
    usual_noise,
)

Array = NDArray[np.float64]

SMALLEST_RATIO = 1.7
"""Of all channels at once. The smallest usual step of an amplifier is 2; on clean campaigns of five rigs the noise of
wind runs is 0.89 to 1.13 times the usual one."""
SAME_RATIO = 1.3
"""Ratio of two ratios up to which they have one cause: noise repeats to some tenths."""


def noise_findings(
    runs: Sequence[Run], channel_names: tuple[str, ...], stored: Sequence[UsualNoise] = ()
) -> list[ConsistencyFinding]:
    """Return findings for the wind runs in which all channels have much less or more noise than in the other runs.

    Runs that have it alike have one cause, and are one finding. `stored` is the noise of runs that are not given, those
    that a response was measured in.
    """
    if not any(run.kind == "wind" for run in runs):
        return []
    compared = [run for run in runs if run.kind in (*KINDS_WITH_KNOWN_LOADS, "wind")]
    levels = [level for run in compared if (level := measure_nyquist_noise(run, channel_names)) is not None]
    ratios = _unusual_ratios(levels, channel_names, stored)
    return [_describe(group) for group in _groups_of_equal_ratio(ratios)]


def compare_noise(
    levels: Iterable[RunNoise], channel_names: tuple[str, ...], stored: Sequence[UsualNoise]
) -> list[ConsistencyFinding]:
    """Return the findings of `noise_findings` from the noise of the runs, one for each.

    They stand in the loads of each run, which are the same whichever other runs are reduced with it. `stored` noise
    counts before that of the runs.
    """
    ratios = _unusual_ratios(tuple(levels), channel_names, stored)
    return [_describe({run: ratio}) for run, ratio in ratios.items()]


def _unusual_ratios(
    levels: Sequence[RunNoise], channel_names: tuple[str, ...], stored: Sequence[UsualNoise]
) -> dict[str, float]:
    """Return by what all channels of wind runs have more or less noise than usual, of those where they have."""
    known = (item for item in (*usual_noise(levels, channel_names), *stored) if np.isfinite(item.amplitude).any())
    usual = {item.sample_rate: item for item in known}
    wind = [level for level in levels if level.kind == "wind" and level.sample_rate in usual]
    ratios = {level.run: _common_ratio(level, usual[level.sample_rate], channel_names) for level in wind}
    return {run: ratio for run, ratio in ratios.items() if ratio is not None}


def _groups_of_equal_ratio(ratios: Mapping[str, float]) -> Iterator[dict[str, float]]:
    """The runs in groups of one ratio, in their order: they have one cause, and are one finding."""
    left = dict(ratios)
    while left:
        first = next(iter(left.values()))
        group = {run: ratio for run, ratio in left.items() if 1.0 / SAME_RATIO < ratio / first < SAME_RATIO}
        left = {run: ratio for run, ratio in left.items() if run not in group}
        yield group


def _common_ratio(level: RunNoise, usual: UsualNoise, channel_names: tuple[str, ...]) -> float | None:
    """Return by what all channels have more or less noise than usual; None where not all of them do."""
    place = dict(zip(usual.channel_names, usual.amplitude, strict=True))
    ratios = level.amplitude / np.array([place.get(name, np.nan) for name in channel_names])
    ratios = ratios[np.isfinite(ratios)]
    if not len(ratios):
        return None
    less = ratios.max() < 1.0 / SMALLEST_RATIO
    more = ratios.min() > SMALLEST_RATIO and level.independent
    return float(np.median(ratios)) if less or more else None


def _describe(ratios: Mapping[str, float]) -> ConsistencyFinding:
    ratio = float(np.median([*ratios.values()]))
    text = f"all channels have {ratio:.3g} times the noise that they have in the runs with known loads"
    cause = "another gain, unit or filter?"
    if ratio > 1.0:
        cause += " Noise of drive or flow, which changes no load, looks the same"
    return ConsistencyFinding(NOISE_LEVEL, WARNING, f"{text}: {cause}", tuple(ratios), factor=float(f"{ratio:.3g}"))
