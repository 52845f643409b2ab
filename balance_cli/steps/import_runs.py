"""From foreign files and a map to a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.additions import FORCE, TEMPERATURE, RunAdditions
from balance_cli.campaign.recording.dataset_checks import KINDS_WITH_LOADS
from balance_cli.campaign.recording.import_map import ImportMap
from balance_cli.campaign.recording.import_map_file import DeclaredRun
from balance_cli.campaign.recording.recorded_time import date_of_start, unreadable_time
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.rig.attitude import ANGLES
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.importers.base import ForeignFile
from balance_cli.io.errors import UserError
from balance_cli.io.units import VOLTAGE
from balance_cli.signals.impact import IMPACT, find_hits, has_hit
from balance_cli.signals.rotor.pulse_consistency import speed_fault
from balance_cli.signals.rotor.tachometer import RotorReference
from balance_cli.signals.run_samples import sample_rate
from balance_cli.steps.import_additions import addition_signals, additions_of
from balance_cli.steps.import_excitation import excitation_signals
from balance_cli.steps.import_labels import point_labels
from balance_cli.steps.import_level import rms_about_drift
from balance_cli.steps.import_rotor import rotor_reference
from balance_cli.steps.import_signals import ANGLE_UNIT, ChannelFinder, Signal, mapped_signals, other_signal
from balance_cli.steps.import_source import ImportedSource, SignalMatrix, signal_matrix
from balance_cli.steps.import_timeline import Clock, Timeline, common_timeline, timeline_notes

Array = NDArray[np.float64]

KINDS_WITH_ROTOR = ("check", "wind")
FASTEST_ALIAS = 10.0
"""Speed over that of the pulses, below which a rotor may be meant: nobody is mistaken about it by more."""
BLOCK = 65536
"""Samples that are held at once: 16 MB with 32 signals."""
LEVEL_DIGITS = 6
"""Significant digits of a measured level, more than any force cell has."""


@dataclass(frozen=True)
class ImportedRun:
    """A run whose samples are still in the foreign files, its rotor reference, and notes on what was done.

    `start` [s] is the time of its first sample on the clock of the files; None in a static run.
    """

    run: Run
    reference: RotorReference | None
    notes: tuple[str, ...]
    start: float | None


def import_run(declared: DeclaredRun, files: Sequence[ForeignFile]) -> ImportedRun:
    """Make the run that these files and the map declare.

    Raises UserError where a channel of the map is absent or unusable, a unit is missing or of the wrong dimension, time
    or rotor reference cannot be determined, or the settings of the run do not fit its kind.
    """
    entry, mapping = declared.entry, declared.mapping
    finder = ChannelFinder(files, mapping, are_in_time=entry.kind != "static")
    channels = mapped_signals(finder, mapping.channels)
    has_loads = entry.kind in KINDS_WITH_LOADS
    loads, load_notes = _load_signals(finder, declared) if has_loads else ([], [])
    others = addition_signals(finder, mapping, has_loads)
    supplies = excitation_signals(finder, mapping.channels)
    measuring = [*channels, *loads, *others.get(FORCE, ())]
    slow = [*supplies.signals, *others.get(TEMPERATURE, ())]
    timeline, notes = _timeline(finder, measuring, slow, mapping) if entry.kind != "static" else (None, [])
    matrix = _matrix(finder, [*channels, *loads, *supplies.signals], timeline)
    matrices = {name: _matrix(finder, group, timeline) for name, group in others.items()}
    _check_rows(matrix, matrices)
    load_columns = tuple(COMPONENTS.index(signal.target) for signal in loads) if loads else None
    run = Run(
        name=entry.run,
        rig=mapping.rig,
        kind=entry.kind,
        channel_names=tuple(signal.target for signal in channels),
        samples=matrix.samples,
        source=ImportedSource(matrix, len(channels), load_columns, supplies.of_columns(len(channels) + len(loads))),
        has_loads=load_columns is not None,
        sample_rate=None if timeline is None else timeline.rate,
        rotor_speed=entry.rotor_speed or 0.0,
        excited=entry.excited,
        excitation=entry.excitation,
        level=entry.level,
        period=entry.period,
        trim=entry.trim,
        attitude=_attitude(finder, mapping, matrix.samples) if entry.kind == "static" else None,
        recorded=entry.recorded or next((file.recorded for file in files if file.recorded), None),
        note=entry.note,
        path=files[0].path,
        additions=additions_of(mapping, matrices),
        reading_units={each.target: each.reading_unit for each in channels if each.reading_unit != VOLTAGE},
        **(point_labels(finder, mapping) if entry.kind == "static" else {}),
    )
    notes = [*_file_notes(finder, mapping, [*measuring, *slow], has_loads), *notes, *supplies.notes, *load_notes]
    return _complete(run, finder, mapping, timeline, notes, entry.rotor_speed)


def _load_signals(finder: ChannelFinder, declared: DeclaredRun) -> tuple[list[Signal], list[str]]:
    """The hub loads of a run; of a sweep those that its files have or that were excited, and a note on the others."""
    loads, excited = declared.mapping.loads, declared.entry.excited
    if declared.entry.kind != "sweep":
        return mapped_signals(finder, loads), []
    silent = [name for name, load in loads.items() if load.component not in excited and not finder.has(name)]
    notes = [f"not recorded, and declared to be zero: {', '.join(silent)}"] if silent else []
    return mapped_signals(finder, {name: load for name, load in loads.items() if name not in silent}), notes


def _file_notes(finder: ChannelFinder, mapping: ImportMap, signals: Sequence[Signal], has_loads: bool) -> list[str]:
    """What is to be told of the files, their times and units, and of loads that a run of this kind does not have."""
    notes = [*(note for file in finder.files for note in file.notes), *finder.clock_notes]
    notes += [note for signal in signals for note in (signal.note, signal.scale_note) if note]
    unused = [*mapping.loads, *(point.channel for point in mapping.load_points)]
    if unused and not has_loads:
        notes.append(f"a run of this kind has no loads: {', '.join(unused)} left out")
    return notes


def _timeline(
    finder: ChannelFinder, measuring: Sequence[Signal], slow: Sequence[Signal], mapping: ImportMap
) -> tuple[Timeline, list[str]]:
    """The time base of all signals, of which `slow` ones do not set the rate, and notes on what was aligned."""
    names: dict[int, list[str]] = {}
    for signal in [*measuring, *slow]:
        names.setdefault(id(signal.source.group), []).append(signal.source.name)
    clocks = {id(signal.source.group): finder.clock(signal.source) for signal in [*measuring, *slow]}
    of_loads = {id(signal.source.group) for signal in measuring}
    _require_common_part(clocks, names, str(finder.files[0].path))
    try:
        timeline = common_timeline(
            [clock for key, clock in clocks.items() if key in of_loads],
            mapping.resample,
            [clock for key, clock in clocks.items() if key not in of_loads],
        )
    except UserError as error:
        raise error.with_location(file=str(finder.files[0].path)) from error
    notes = timeline_notes(timeline, [(names[key], clock) for key, clock in clocks.items()])
    if len(finder.files) > 1:
        notes.append(f"the clocks of {len(finder.files)} files are taken as one")
    return timeline, notes


def _require_common_part(clocks: Mapping[int, Clock], names: Mapping[int, Sequence[str]], file: str) -> None:
    """Raise UserError, with the channels and times, where one begins after another has ended."""
    last = max(clocks, key=lambda key: clocks[key].start)
    first = min(clocks, key=lambda key: clocks[key].end)
    if clocks[last].start >= clocks[first].end:
        begin = f"`{names[last][0]}` begins at {clocks[last].start:.6g} s"
        fault = f"{begin}, where `{names[first][0]}` has ended at {clocks[first].end:.6g} s"
        raise UserError(fault, file, "time", "Leave one of them out of the map, or import them as different runs")


def _matrix(finder: ChannelFinder, signals: Sequence[Signal], timeline: Timeline | None) -> SignalMatrix:
    if timeline is not None:
        clocks = [finder.clock(signal.source) for signal in signals]
        return signal_matrix(signals, clocks, timeline, timeline.samples)
    first = signals[0].source
    for signal in signals:
        if signal.source.group.samples != first.group.samples:
            fault = f"has {signal.source.group.samples} rows, but `{first.name}` has {first.group.samples}"
            place = f"channel `{signal.source.name}`"
            raise UserError(fault, str(signal.source.file.path), place, "A static run needs a row for each load point")
    return signal_matrix(signals, [None] * len(signals), None, first.group.samples)


def _attitude(finder: ChannelFinder, mapping: ImportMap, samples: int) -> Array | None:
    """Pitch and roll (n, 2) [deg] of a static run."""
    if not mapping.attitude:
        return None
    signals = [
        other_signal(finder.find(name), mapped.angle, mapped, *ANGLE_UNIT) for name, mapped in mapping.attitude.items()
    ]
    matrix = signal_matrix(signals, [None] * len(signals), None, samples)
    values = matrix.read(0, samples)
    return values[:, [matrix.targets.index(name) for name in ANGLES]]


def _complete(
    run: Run,
    finder: ChannelFinder,
    mapping: ImportMap,
    timeline: Timeline | None,
    notes: list[str],
    stated_speed: float | None,
) -> ImportedRun:
    """The run with its pulses, its speed and, of a sweep, the rms of its excitation."""
    notes += filter(None, [unreadable_time(run.recorded)])
    reference = None
    if mapping.rotor is not None and timeline is not None:
        try:
            reference = rotor_reference(finder, mapping.rotor, timeline, "rotor")
        except UserError as error:
            if run.kind in KINDS_WITH_ROTOR and stated_speed != 0.0:
                raise
            notes.append(f"no rotor pulses: {error.fault}")
    if reference is not None:
        notes += reference.notes
        run = _with_pulses(run, reference, stated_speed, notes)
        if mapping.rotor2 is not None and timeline is not None:
            second = rotor_reference(finder, mapping.rotor2, timeline, "rotor2")
            notes += [f"rotor2: {note}" for note in (f"mean rate {second.mean_rate:.6g} Hz", *second.notes)]
            run = _with_second_rotor(run, second)
    if run.kind == "sweep" and run.excited and not run.level and (run.has_loads or _has_forces_only(run)):
        run = replace(run, level=_rms_levels(run))
        notes.append(f"level of the excitation, rms over the record: {', '.join(f'{x:.4g}' for x in run.level)}")
    start = None if timeline is None else timeline.start
    run = replace(run, recorded=run.recorded or date_of_start(start))
    if run.excitation == IMPACT and (run.has_loads or _has_forces_only(run)):
        notes += _hit_notes(run)
    return ImportedRun(run, reference, tuple(dict.fromkeys(notes)), start)


def _check_rows(matrix: SignalMatrix, others: Mapping[str, SignalMatrix]) -> None:
    """Raise UserError where a static run has more or fewer temperatures or forces than load points."""
    for name, other in others.items():
        if other.samples != matrix.samples:
            fault = f"`{name}` has {other.samples} rows, the channels have {matrix.samples}"
            raise UserError(fault, str(matrix.groups[0].signals[0].source.file.path), remedy="Give one for each row")


def _with_second_rotor(run: Run, second: RotorReference) -> Run:
    additions = run.additions or RunAdditions()
    return replace(run, additions=replace(additions, further_pulse_times=(second.pulse_times,)))


def _with_pulses(run: Run, reference: RotorReference, stated: float | None, notes: list[str]) -> Run:
    additions = replace(run.additions or RunAdditions(), azimuth_error_deg=reference.azimuth_error_deg)
    run = replace(run, additions=additions)
    if stated is None:
        if reference.alias_rate < FASTEST_ALIAS * reference.mean_rate:
            faster, slower = (f"{speed:.4g} Hz" for speed in (reference.alias_rate, reference.mean_rate))
            fault = f"pulses of a rotor at {faster} look the same as these of {slower}"
            remedy = "The tachometer has few samples for each pulse: state `rotor_speed` in the entry of the run"
            raise UserError(fault, run.file, "rotor", remedy)
        speed = float(f"{reference.mean_rate:.6g}")
        notes.append(f"rotor speed {speed:g} Hz, the mean rate of the pulses")
        return replace(run, pulse_times=reference.pulse_times, rotor_speed=speed)
    fault = speed_fault(reference.mean_rate, stated) if stated else ""
    if fault:
        remedy = "Correct `rotor_speed`, or `pulses_per_revolution` and `level` of `rotor`"
        raise UserError(fault, run.file, "rotor", remedy)
    return replace(run, pulse_times=reference.pulse_times)


def _hit_notes(run: Run) -> list[str]:
    """A note on the taps of each excited load."""
    columns = [COMPONENTS.index(name) for name in run.excited]
    starts = range(0, run.samples, BLOCK)
    parts = [_recorded_loads(run, start, min(start + BLOCK, run.samples)) for start in starts]
    loads = np.concatenate([part[:, columns] for part in parts])
    notes = [
        find_hits(column, sample_rate(run)).note if has_hit(column) else "no hit of the hammer stands out of the noise"
        for column in loads.T
    ]
    return [f"{name}: {note}" for name, note in zip(run.excited, notes, strict=True)]


def _has_forces_only(run: Run) -> bool:
    """Whether the excited components are forces, and their only record is that of forces at points."""
    points = None if run.additions is None else run.additions.load_points
    return points is not None and not points.are_named_only and set(run.excited) <= set(COMPONENTS[:3])


def _rms_levels(run: Run) -> tuple[float, ...]:
    """Root mean square [N, N m] of the excited loads about their means; of one that drifts about its drift."""
    blocks = (
        (start, _recorded_loads(run, start, min(start + BLOCK, run.samples))) for start in range(0, run.samples, BLOCK)
    )
    rms = rms_about_drift(blocks, run.samples)
    return tuple(float(f"{rms[COMPONENTS.index(name)]:.{LEVEL_DIGITS}g}") for name in run.excited)


def _recorded_loads(run: Run, start: int, stop: int) -> Array:
    """Hub loads (m, 6); without any, the forces at points, whose moments about the hub the map does not tell."""
    if run.has_loads:
        loads = run.read(start, stop).loads
        assert loads is not None
        return loads
    assert run.additions is not None
    return run.additions.hub_loads(np.zeros(3), start, stop)
