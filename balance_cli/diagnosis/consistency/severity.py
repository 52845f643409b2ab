"""What a finding means for a command: a factor that it measures itself is no fault there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from balance_cli.diagnosis.consistency import findings as kinds
from balance_cli.diagnosis.consistency.findings import WARNING, ConsistencyFinding
from balance_cli.diagnosis.consistency.units import FORCE_UNITS, UNIT_TOLERANCE, VOLT_UNITS, suggest_units

ConsequenceRule = Callable[[ConsistencyFinding], bool]
"""Whether a finding that is a fault by itself is only a warning for a command."""

LOAD_KINDS = (kinds.REVERSED_LOAD, kinds.EXCHANGED_LOADS, kinds.LOAD_FACTOR)
FACTOR_KINDS = (kinds.CHANNEL_FACTOR, kinds.CHANNELS_FACTOR)
MOST_NOISE = 30.0
"""Noise of all channels over that of the sweeps from which it is another unit: volts in mV have 1000 times as much, and
noise of drive and flow was at most 8 times that of sound sweeps. Gains of amplifiers lie below, as that noise does."""
LARGE_FACTOR = 2.0
"""Factor from which a channel is named as wrong by `check`: no effect of a rig changes a channel so much in one run."""


def measured_anyway(finding: ConsistencyFinding) -> bool:
    """The rule of `calibrate` and `sweep-tf`, which measure what the channels read for each load.

    What is the same in all runs is part of what they measure, whatever the geometry says of it; loads are not. Of all
    channels a factor that is one between units of force, and of no voltage, is one of the loads.
    """
    is_of_loads = finding.kind in LOAD_KINDS or (finding.kind == kinds.CHANNELS_FACTOR and _is_of_force(finding.factor))
    return finding.in_all_runs and not is_of_loads


def _is_of_force(factor: float | None) -> bool:
    """Whether loads in another unit explain a factor of all channels, and neither volts nor an amplifier do."""
    if not factor or abs(np.log10(abs(factor)) - round(np.log10(abs(factor)))) < UNIT_TOLERANCE / 2:
        return False
    return bool(suggest_units(1.0 / factor, FORCE_UNITS)) and not suggest_units(factor, VOLT_UNITS)


def identified_anyway(finding: ConsistencyFinding) -> bool:
    """The rule of `identify` and `diagnose`, which can find the factor of one channel if it is the same in all runs."""
    return finding.in_all_runs and finding.kind == kinds.CHANNEL_FACTOR and len(finding.channels) == 1


def known_anyway(finding: ConsistencyFinding) -> bool:
    """The rule of `reduce`, whose calibration and model know factors of channels, and tell loads from channels."""
    return finding.kind in FACTOR_KINDS


def contradicts_loads(kind: str, in_all_runs: bool, factor: float | None = None) -> bool:
    """Whether a warning of this kind makes the loads of the runs that show it doubtful.

    A hub elsewhere changes moments, and another noise of all channels is that of another gain, unit or filter. A large
    factor of channels that other runs do not have came after the sweeps; a small one may be an effect that the model
    knows.
    """
    if kind in FACTOR_KINDS and not in_all_runs and factor:
        return not 1.0 / LARGE_FACTOR <= abs(factor) <= LARGE_FACTOR
    return kind in (kinds.DIFFERENT_RIG, kinds.HUB_POSITION, kinds.NOISE_LEVEL, kinds.DELAY)


def leaves_loads_untested(kind: str, factor: float | None) -> bool:
    """Whether a warning says no more than that a factor of all channels is possible, which nothing tests.

    Noise of drive or flow is more than that of the sweeps and changes no load; noise that is less has another cause.
    """
    return kind == kinds.NOISE_LEVEL and factor is not None and 1.0 < factor < MOST_NOISE


def findings_for_command(
    findings: Sequence[ConsistencyFinding], is_harmless: ConsequenceRule
) -> tuple[ConsistencyFinding, ...]:
    """Return the findings with those that are harmless to a command as warnings; faults first."""
    judged = [replace(item, severity=WARNING) if item.is_fault and is_harmless(item) else item for item in findings]
    return tuple(sorted(judged, key=lambda finding: not finding.is_fault))
