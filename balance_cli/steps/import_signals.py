"""Channels of foreign files as signals of ours: found by name, with unit, sign and scale."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from balance_cli.campaign.recording.import_map import ImportMap, MappedChannel, MappedLoad
from balance_cli.campaign.rig.components import UNIT_OF
from balance_cli.importers.base import ChannelGroup, ForeignFile
from balance_cli.importers.time_axis import read_time_axis
from balance_cli.importers.uneven_times import evened_group
from balance_cli.io.errors import UserError
from balance_cli.io.units import ACCELERATION, ANGLE, FORCE, NUMBER, RATIO, TEMPERATURE, VOLTAGE, Unit, parse_unit
from balance_cli.steps.import_channels import FIRST, ChannelNames, FoundChannel
from balance_cli.steps.import_pieces import joined_pieces
from balance_cli.steps.import_timeline import Clock
from balance_cli.steps.stated_rates import contradiction, time_unit

CONTRADICTION = 1e-3
"""Relative difference from which the sample rate of the map contradicts that of the file."""
SLOWEST_RATE, FASTEST_RATE = 1e-5, 1e9
"""[Hz]. One sample a day, and what no converter of a balance reaches."""
LEAST_COMMON_LENGTH = 0.9
"""Of the longest channel at one rate in a file: the others end a block of the logger earlier at most. A lower rate is
half or less."""
LATEST_START = 1e12
"""[s]. Clocks count from the year 0 at the earliest."""

WHOLE_STEP = 1e-6
"""Difference of a step of times from a whole number that rounding leaves."""


@dataclass(frozen=True)
class Signal:
    """A channel in our units: factor times the file's value, plus offset. `target` is the column that it fills.

    `reading_unit`: base unit of a channel, V or a ratio to the excitation of its bridge. `note` and `scale_note` say
    what is to be told of its unit, and of a scale in the file that was not applied.
    """

    source: FoundChannel
    target: str
    factor: float
    offset: float
    note: str = ""
    reading_unit: str = VOLTAGE
    scale_note: str = ""


class ChannelFinder(ChannelNames):
    """The channels of the files of one run, by name, with their clocks."""

    def __init__(self, files: Sequence[ForeignFile], declared: ImportMap, are_in_time: bool = True) -> None:
        used = _used_names(declared)
        pieces = joined_pieces(files, used, declared.time)
        super().__init__([_evened(file, declared) for file in pieces] if are_in_time else pieces, used)
        self._map = declared
        self._clocks: dict[int, tuple[Clock, str]] = {}
        self._at_stated_rate: dict[str, FoundChannel] = {}

    def clock(self, channel: FoundChannel) -> Clock:
        """Rate and start of a channel's group: from the file, from its time column, or from the map."""
        key = id(channel.group)
        if key not in self._clocks:
            self._clocks[key] = self._read_clock(channel)
            _require_possible_clock(self._clocks[key][0], channel)
        return self._clocks[key][0]

    @property
    def clock_notes(self) -> list[str]:
        """What is to be told of the time columns that were read."""
        return list(dict.fromkeys(note for _, note in self._clocks.values() if note))

    def _read_clock(self, channel: FoundChannel) -> tuple[Clock, str]:
        group, stated = channel.group, self._map.sample_rate
        file, place = str(channel.file.path), f"channel `{channel.name}`"
        if group.rate is not None:
            if stated is not None and abs(stated / group.rate - 1.0) > CONTRADICTION:
                fault = f"was sampled at {group.rate:.10g} Hz, but the map says `sample_rate: {stated:.10g}`"
                raise UserError(fault, file, place, "Correct or remove `sample_rate` (`resample` changes the rate)")
            return Clock(group.rate, group.start, group.samples), ""
        if group.time is not None:
            return self._clock_by_time(group, FoundChannel(group.names[group.time], channel.file, group, group.time))
        if stated is not None:
            self._require_one_length(channel)
            note = contradiction(channel.file, stated, "the map")
            return _strided(Clock(stated, group.start, group.samples), group), note
        if self._map.time is None:
            raise UserError("has no sample rate", file, place, "Add `time: CHANNEL` or `sample_rate: HZ` to the map")
        return self._clock_by_time(group, self._time_of(channel))

    def _require_one_length(self, channel: FoundChannel) -> None:
        """Raise UserError where channels of one file are of different lengths: they are not all at the stated rate."""
        first = self._at_stated_rate.setdefault(str(channel.file.path), channel)
        lengths = [each.group.samples * each.group.stride for each in (first, channel)]
        if min(lengths) < LEAST_COMMON_LENGTH * max(lengths):
            fault = f"has {lengths[1]} samples, `{first.name}` has {lengths[0]}: they are not both at `sample_rate`"
            remedy = "Leave one of them out of the map, or export them with times or with their own rates"
            raise UserError(fault, str(channel.file.path), f"channel `{channel.name}`", remedy)

    def _time_of(self, channel: FoundChannel) -> FoundChannel:
        """The time in the file of a channel; a file without one is on the time of another."""
        assert self._map.time is not None
        key = " ".join(self._map.time.split())
        for group in channel.file.groups:
            if key in group.names:
                return FoundChannel(key, channel.file, group, group.names.index(key))
        return self.find(key)

    def _clock_by_time(self, group: ChannelGroup, time: FoundChannel) -> tuple[Clock, str]:
        if time.group.samples != group.samples and group.stride == 1:
            fault = f"the time `{time.name}` has {time.group.samples} samples, channels have {group.samples}"
            raise UserError(fault, str(time.file.path), remedy="Give the time of these channels, or `sample_rate`")
        try:
            unit = time_unit(self._map.time_unit or time.unit or "s")
        except UserError as error:
            raise error.with_location(str(time.file.path), f"time `{time.name}`") from error
        try:
            axis = read_time_axis(
                lambda columns, a, b: time.group.read([time.column], a, b), time.group.samples, unit.factor
            )
        except UserError as error:
            place = f"time `{time.name}`" + (f", {error.place}" if error.place else "")
            raise UserError(error.fault, str(time.file.path), place, error.remedy) from error
        notes = (
            axis.note,
            contradiction(time.file, axis.rate, f"its times `{time.name}`"),
            "" if self._map.time_unit or time.unit else _assumed_seconds(time.name, axis.rate),
        )
        return _strided(Clock(axis.rate, axis.start, group.samples), group), "; ".join(filter(None, notes))


def _assumed_seconds(name: str, rate: float) -> str:
    """Say that times without a unit whose steps are whole numbers were taken as seconds; empty of other steps."""
    step = 1.0 / rate
    if step < 1.0 - WHOLE_STEP or abs(step - round(step)) > WHOLE_STEP:
        return ""
    return f"the times `{name}` have no unit and were taken as seconds, {rate:.4g} Hz: state `time_unit` if they are ms"


def _evened(file: ForeignFile, declared: ImportMap) -> ForeignFile:
    """The file with its samples at even times, where `resample` of the map asks for them and the times are uneven."""
    if declared.resample is None or declared.time is None or declared.sample_rate is not None:
        return file
    key, groups, notes = " ".join(declared.time.split()), [], list(file.notes)
    for group in file.groups:
        evened = None
        if group.rate is None and group.time is None and group.stride == 1 and key in group.names:
            column = group.names.index(key)
            factor = _time_factor(declared.time_unit or group.channels[column].unit)
            times = group.read([column], 0, group.samples)[:, 0] * factor
            evened = evened_group(group, times, declared.resample)
        groups.append(group if evened is None else evened.group)
        notes += [] if evened is None else [evened.note]
    return replace(file, groups=tuple(groups), notes=tuple(notes))


def _time_factor(unit: str) -> float:
    """Seconds of one unit of time; 1 for one that is unknown, which is refused where the clock is read."""
    try:
        return time_unit(unit or "s").factor
    except UserError:
        return 1.0


def _used_names(declared: ImportMap) -> set[str]:
    mapped = {*declared.channels, *declared.loads, *declared.attitude, *declared.temperature}
    names = mapped | {point.channel for point in declared.load_points}
    return names | {name.removesuffix(FIRST) for name in names}


def _strided(clock: Clock, group: ChannelGroup) -> Clock:
    """The clock of a group that has samples in every `stride`-th row of this clock only."""
    return Clock(clock.rate / group.stride, clock.start + group.first_row / clock.rate, group.samples)


def _require_possible_clock(clock: Clock, channel: FoundChannel) -> None:
    """Raise UserError for a rate or a start that no record has."""
    if not (SLOWEST_RATE <= clock.rate <= FASTEST_RATE and abs(clock.start) <= LATEST_START):
        fault = f"was sampled at {clock.rate:g} Hz from {clock.start:g} s on"
        remedy = "State `sample_rate` or `time_unit` in the map, or export the file again"
        raise UserError(fault, str(channel.file.path), f"channel `{channel.name}`", remedy)


def channel_signal(source: FoundChannel, mapped: MappedChannel) -> Signal:
    """A channel in volts or, without `scale`, in V/V or counts; of another unit `scale` says how many volts it is."""
    # `g` is an acceleration here: nothing that is sampled is a mass.
    dimensions = (ACCELERATION,) if (mapped.unit or source.unit).strip() == "g" else ()
    unit, note = _unit(source, mapped.unit, *dimensions)
    has_scale = "scale" in mapped.model_fields_set
    if unit.dimension in (RATIO, NUMBER) and not has_scale and mapped.excitation is None:
        signal = _signal(source, mapped.name, unit, mapped, note)
        return replace(signal, reading_unit=unit.dimension)
    if unit.dimension != VOLTAGE and not has_scale:
        fault = f"is in {unit.symbol}, not in volts"
        remedy = f"Add `scale` to its entry: volts for one {unit.dimension} (for V/V the excitation voltage)"
        raise UserError(fault, str(source.file.path), f"channel `{source.name}`", remedy)
    return _signal(source, mapped.name, unit, mapped, note)


def load_signal(source: FoundChannel, mapped: MappedLoad) -> Signal:
    """A hub load in N or N m."""
    unit, note = _unit(source, mapped.unit, UNIT_OF[mapped.component])
    return _signal(source, mapped.component, unit, mapped, note)


def other_signal(source: FoundChannel, target: str, mapped: object, dimension: str, default: str) -> Signal:
    """An angle in deg, a temperature in degC, or a force in N."""
    stated = getattr(mapped, "unit", None) or source.unit or default
    unit, note = _unit(source, stated, dimension)
    if dimension == ANGLE:
        unit = Unit(unit.symbol, ANGLE, unit.factor / parse_unit("deg", ANGLE).factor)
    return _signal(source, target, unit, mapped, note)


def _signal(source: FoundChannel, target: str, unit: Unit, mapped: Any, note: str) -> Signal:
    """The signal of an entry of the map. Raises UserError for raw values of a channel whose entry states no `scale`."""
    has_scale = "scale" in mapped.model_fields_set
    if source.is_raw and not has_scale:
        fault = f"holds raw values: {source.scale} cannot be applied"
        remedy = f"Add `scale` to its entry, or export it in {unit.symbol}"
        raise UserError(fault, str(source.file.path), f"channel `{source.name}`", remedy)
    scale_note = ""
    if source.scale and not has_scale:
        stated = f"{source.scale}, as the file states, was not applied"
        scale_note = f"{source.name}: integers; {stated}, since the map has no `scale`"
    factor = mapped.sign * mapped.scale * unit.factor
    shift = mapped.sign * mapped.scale * unit.offset - factor * mapped.offset
    return Signal(source, target, factor, shift, note, scale_note=scale_note)


def _unit(source: FoundChannel, stated: str | None, *dimensions: str) -> tuple[Unit, str]:
    """The unit of the map, else that of the file; a note where they contradict each other."""
    place = f"channel `{source.name}`"
    text = stated or source.unit
    if not text:
        raise UserError("has no unit", str(source.file.path), place, "Add `unit` to its entry in the map")
    try:
        unit = parse_unit(text, *dimensions)
    except UserError as error:
        raise error.with_location(str(source.file.path), place) from error
    if not stated or not source.unit:
        return unit, ""
    try:
        same = parse_unit(source.unit, *dimensions) == unit
    except UserError:
        same = source.unit.strip() == text.strip()
    return unit, "" if same else f"{source.name}: the file says `{source.unit}`, the map `{text}`, which was taken"


TEMPERATURE_UNIT, FORCE_UNIT, ANGLE_UNIT = (TEMPERATURE, "degC"), (FORCE, "N"), (ANGLE, "deg")
"""Dimension and default unit of temperatures, forces at points and angles."""


def mapped_signals(
    finder: ChannelFinder, entries: Mapping[str, MappedChannel] | Mapping[str, MappedLoad]
) -> list[Signal]:
    """The signals of the channels or loads of a map."""
    signals = []
    for name, mapped in entries.items():
        source = finder.find(name)
        signals.append(
            channel_signal(source, mapped) if isinstance(mapped, MappedChannel) else load_signal(source, mapped)
        )
    return signals
