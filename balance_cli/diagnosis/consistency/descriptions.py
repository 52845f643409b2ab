"""Mistakes in words: which channels, loads or cells, in which runs, and which units would explain a factor."""

from __future__ import annotations

from collections.abc import Sequence

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.consistency import findings as kinds
from balance_cli.diagnosis.consistency.findings import FAULT, WARNING, ConsistencyFinding
from balance_cli.diagnosis.consistency.hypotheses import (
    EXCHANGE_CHANNELS,
    EXCHANGE_LOADS,
    SCALE_CHANNELS,
    TURN_LOADS,
    Hypothesis,
)
from balance_cli.diagnosis.consistency.search import Mistake
from balance_cli.diagnosis.consistency.units import FORCE_UNITS, MOMENT_UNITS, VOLT_UNITS, suggest_units

SIGN_TOLERANCE = 0.2
"""Departure of a factor from -1 that is still taken for a reversed sign."""
SMALLEST_GAIN = 0.1
"""Departure of a factor from 1 that is worth a warning; calibration and identification take up smaller ones."""
LARGEST_GAIN = 2.0
"""Factor from which (or from its reciprocal) no tolerance of a sensor, but a unit or an amplifier, is the cause."""


def describe_mistakes(mistakes: Sequence[Mistake], geometry: Geometry) -> tuple[ConsistencyFinding, ...]:
    """Return a finding for each mistake; equal ones of several runs are one."""
    merged: dict[tuple[object, ...], ConsistencyFinding] = {}
    for mistake in mistakes:
        finding = _describe(mistake, geometry)
        if finding is None:
            continue
        key = (finding.kind, finding.channels, finding.components, finding.cells, finding.text)
        earlier = merged.get(key)
        if earlier is not None:
            runs = tuple(dict.fromkeys((*earlier.runs, *finding.runs)))
            finding = _with_runs(finding, runs, earlier.in_all_runs and finding.in_all_runs)
        merged[key] = finding
    return tuple(merged.values())


def _with_runs(finding: ConsistencyFinding, runs: tuple[str, ...], everywhere: bool) -> ConsistencyFinding:
    from dataclasses import replace

    return replace(finding, runs=runs, in_all_runs=everywhere)


def _describe(mistake: Mistake, geometry: Geometry) -> ConsistencyFinding | None:
    hypothesis = mistake.hypothesis
    if hypothesis.kind == TURN_LOADS:
        return _turned_loads(mistake)
    if hypothesis.kind in (EXCHANGE_CHANNELS, EXCHANGE_LOADS):
        return _exchange(mistake, geometry)
    factor = 1.0 / mistake.factor if mistake.factor else float("inf")
    if abs(factor - 1.0) < SMALLEST_GAIN:
        return None
    reversed_sign = abs(factor + 1.0) < SIGN_TOLERANCE
    large = factor < 0 or not 1.0 / LARGEST_GAIN < factor < LARGEST_GAIN
    if hypothesis.kind == SCALE_CHANNELS:
        return _channel_factor(mistake, geometry, factor, reversed_sign, FAULT if large else WARNING)
    return _load_factor(mistake, factor, reversed_sign, FAULT if large else WARNING)


def _finding(mistake: Mistake, kind: str, severity: str, text: str, **names: object) -> ConsistencyFinding:
    if mistake.alternative_runs:
        text += f" (or in {' or '.join(mistake.alternative_runs)}, which contradict it)"
    return ConsistencyFinding(kind, severity, text, mistake.runs, mistake.everywhere, **names)  # type: ignore[arg-type]


def _exchange(mistake: Mistake, geometry: Geometry) -> ConsistencyFinding:
    if mistake.hypothesis.kind == EXCHANGE_LOADS:
        names = tuple(COMPONENTS[j] for j in mistake.hypothesis.indices)
        text = f"the loads {names[0]} and {names[1]} are exchanged"
        return _finding(mistake, kinds.EXCHANGED_LOADS, FAULT, text, components=names)
    channels = tuple(geometry.channel_names[i] for i in mistake.hypothesis.indices)
    if len(channels) > 2:
        cells = tuple(str(geometry.channels[i].cell) for i in mistake.hypothesis.indices[:2])
        text = f"the channels of {cells[0]} and {cells[1]} are exchanged, or the cells in the geometry"
        return _finding(mistake, kinds.EXCHANGED_CHANNELS, FAULT, text, channels=channels, cells=cells)
    text = f"{channels[0]} and {channels[1]} are exchanged" + _or_rivals(mistake, geometry)
    return _finding(mistake, kinds.EXCHANGED_CHANNELS, FAULT, text, channels=channels)


def _turned_loads(mistake: Mistake) -> ConsistencyFinding:
    """The loads that are in other axes than the rig's, as each would have to be read."""
    index = mistake.hypothesis.indices
    changed = [j for j, place in enumerate(index) if place != j + 1]
    names = tuple(COMPONENTS[j] for j in changed)
    read = ", ".join(f"{'-' * (index[j] < 0)}{COMPONENTS[abs(index[j]) - 1]}" for j in changed)
    text = f"the loads are in other axes than those of the rig: {', '.join(names)} of the rig are {read}"
    return _finding(mistake, kinds.EXCHANGED_LOADS, FAULT, text, components=names)


def _rival_names(mistake: Mistake, geometry: Geometry) -> list[str]:
    """Return the channels that each rival concerns."""
    return [" and ".join(geometry.channel_names[i] for i in rival.indices) for rival in mistake.rivals]


def _or_rivals(mistake: Mistake, geometry: Geometry) -> str:
    return "".join(f" (or {names})" for names in _rival_names(mistake, geometry))


def _channel_factor(
    mistake: Mistake, geometry: Geometry, factor: float, reversed_sign: bool, severity: str
) -> ConsistencyFinding:
    index = mistake.hypothesis.indices
    names = tuple(geometry.channel_names[i] for i in index)
    if len(index) == len(geometry.channels):
        return _all_channels(mistake, names, factor, reversed_sign, severity)
    cells = tuple(dict.fromkeys(str(geometry.channels[i].cell) for i in index))
    whole_cell = _is_whole_cell(mistake.hypothesis, geometry)
    if reversed_sign:
        text = f"{' and '.join(names)} {'are' if len(names) > 1 else 'is'} reversed"
        if not whole_cell:
            text += _or_rivals(mistake, geometry)
            return _finding(mistake, kinds.REVERSED_CHANNEL, FAULT, text, channels=names, factor=factor)
        if mistake.everywhere:
            text += f", or the axis of cell {cells[0]} in the geometry"
        return _finding(mistake, kinds.REVERSED_CELL, FAULT, text, channels=names, cells=cells, factor=factor)
    verb = "read" if len(names) > 1 else "reads"
    if factor < 0:
        verb = f"{'are' if len(names) > 1 else 'is'} reversed, and {verb}"
    text = f"{' and '.join(names)} {verb} {abs(factor):.4g} times what the loads make{_hint(abs(factor), VOLT_UNITS)}"
    if mistake.rivals:
        text += f" (or {' or '.join(_rival_names(mistake, geometry))} {1.0 / abs(factor):.4g} times)"
    kind = kinds.CHANNEL_FACTOR if factor > 0 else kinds.REVERSED_CHANNEL
    return _finding(mistake, kind, severity, text, channels=names, factor=factor)


def _is_whole_cell(hypothesis: Hypothesis, geometry: Geometry) -> bool:
    cell = geometry.channels[hypothesis.indices[0]].cell
    of_cell = {i for i, channel in enumerate(geometry.channels) if channel.cell == cell}
    return cell is not None and of_cell <= set(hypothesis.indices)


def _all_channels(
    mistake: Mistake, names: tuple[str, ...], factor: float, reversed_sign: bool, severity: str
) -> ConsistencyFinding:
    if reversed_sign:
        text = "all channels are reversed, or all loads"
        return _finding(mistake, kinds.REVERSED_CHANNELS, FAULT, text, channels=names, factor=factor)
    text = f"all channels read {factor:.4g} times what the loads make: check the units of `channels` and `loads`"
    units = suggest_units(factor, VOLT_UNITS), suggest_units(1.0 / factor, FORCE_UNITS)
    text += "".join(f"; {name}: {hint}" for name, hint in zip(("volts", "loads"), units, strict=True) if hint)
    return _finding(mistake, kinds.CHANNELS_FACTOR, severity, text, channels=names, factor=factor)


def _load_factor(mistake: Mistake, factor: float, reversed_sign: bool, severity: str) -> ConsistencyFinding:
    names = tuple(COMPONENTS[j] for j in mistake.hypothesis.indices)
    if reversed_sign:
        text = f"the load {', '.join(names)} is reversed"
        return _finding(mistake, kinds.REVERSED_LOAD, FAULT, text, components=names, factor=factor)
    units = FORCE_UNITS if all(name in COMPONENTS[:3] for name in names) else MOMENT_UNITS
    text = f"the load {', '.join(names)} is {factor:.4g} times what the channels show{_hint(factor, units)}"
    return _finding(mistake, kinds.LOAD_FACTOR, severity, text, components=names, factor=factor)


def _hint(factor: float, units: dict[str, float]) -> str:
    hint = suggest_units(factor, units)
    return f": {hint}" if hint else ""
