"""A map to be completed, guessed from the files and a geometry."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import chain
from pathlib import Path

from balance_cli.campaign.recording.dataset_checks import KINDS_WITH_LOADS
from balance_cli.campaign.recording.import_map_file import UNFINISHED
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.importers.base import ForeignChannel, ForeignFile
from balance_cli.io.errors import UserError
from balance_cli.io.formats import IMPORT_FORMAT
from balance_cli.io.units import ACCELERATION, ANGLE, FREQUENCY, NUMBER
from balance_cli.steps.sketched_differences import Entries, base_file, difference_lines, own_channels
from balance_cli.steps.sketched_loads import guess_loads
from balance_cli.steps.sketched_rates import quoted, rate_lines
from balance_cli.steps.sketched_temperatures import guess_temperatures, temperature_lines
from balance_cli.steps.sketched_times import empty_times, even_column, time_channel, unit_of

NO_CHANNELS = "all columns have names of loads: move here what the balance reads"
WEIGHT_NAME = re.compile(r"weight|mass|load|thrust|force|gewicht|masse|last|kraft|schub", re.IGNORECASE)
"""Names of channels whose unit `g` is that of a weight, and no acceleration."""
WEIGHT_UNIT = "gf"
NO_ROTOR = re.compile(r"air|wind|flow|luft", re.IGNORECASE)
"""Names of speeds that are those of the flow."""
TACHOMETER = re.compile(r"tach|rpm|puls|1/?rev|key ?phas|encoder|trigger|drehz|azimu|\bpsi\b|speed", re.IGNORECASE)
ANGLE_NAME = re.compile(r"azimu|\bpsi\b|angle|winkel", re.IGNORECASE)
FREQUENCY_RESPONSE = "a frequency response"
"""How the reader of universal files begins to say why a response is no record."""
SIMILARITY = 0.6
"""Share of equal characters (difflib) from which two names are taken as one."""
KIND_NAMES = {
    "static": ("static", "statisch", "calib", "kalib", "etalon", "cal_", "cal-", "weights"),
    "zero": ("zero", "tare", "tara", "offset", "wind[ _-]?off", "no[ _-]?wind", "nullm", "null_", "null-", "nullpunkt"),
    "sweep": ("sweep", "shake", "frf", "chirp", "random", "hammer", "impact"),
    "check": ("check", "known"),
    "wind": ("wind", "run", "hover", "test"),
}
"""Words in file names that tell the kind of a run, in the order in which they are looked for."""


def sketch_map(files: Sequence[ForeignFile], geometry: Geometry | None) -> str:
    """YAML of a map of these files, with TODO where nothing could be guessed. Raises UserError with the first file."""
    try:
        return _map_of(files, geometry)
    except UserError as error:
        raise error.with_location(file=str(files[0].path)) from error


def _map_of(files: Sequence[ForeignFile], geometry: Geometry | None) -> str:
    first = base_file(files)
    channels = [channel for group in first.groups if not group.unusable for channel in group.channels]
    times = [group.channels[group.time] for group in first.groups if group.time is not None]
    time = times[0] if times else time_channel(first) or even_column(first)
    _require_signals(first, channels, time)
    others = _of_other_length(first, time)
    ignored = [time, *times, *empty_times(first), *others]
    rest = [channel for channel in channels if not any(channel is other for other in ignored)]
    own = {file.path: own_channels(file, first) for file in files}
    tachometer = next((channel for channel in chain(rest, *own.values()) if _is_tachometer(channel)), None)
    rest = [channel for channel in rest if channel is not tachometer]
    kinds = [_kind(file.path) for file in files]
    has_loads = any(kind in (None, *KINDS_WITH_LOADS) for kind in kinds)
    loads, rest = guess_loads(rest) if has_loads else ({}, rest)
    lines = [f"format: {IMPORT_FORMAT}", f"rig: {_rig(geometry)}", *_file_comments(files)]
    if any(kind != "static" for kind in kinds):
        lines += rate_lines(first, time)
    lines += [f"# not as long as `{time.name}`: {', '.join(c.name for c in others)}"] if time and others else []
    temperatures, rest = guess_temperatures(rest, files)
    mapped, free = _guess_channels(rest, geometry)
    channel_line = partial(_channel_line, geometry)
    lines += ["channels:" + ("" if mapped else f" {UNFINISHED}  # {NO_CHANNELS}")]
    lines += [channel_line(*entry) for entry in mapped.values()]
    lines += [f"  # channels of the geometry that were not found: {', '.join(free)}"] if free else []
    lines += temperature_lines(temperatures)
    lines += (
        ["loads:", *(_load_line(*entry) for entry in loads.values())]
        if loads
        else ["# loads:", "#   FILE CHANNEL: {component: Fz, unit: N, sign: 1}"]
    )
    lines += [*_rotor_lines(tachometer, geometry), "runs:"]
    for file in files:
        more = [c for c in own[file.path] if tachometer is None or c.name != tachometer.name]
        more_loads, more = guess_loads(more) if has_loads else ({}, more)
        more_mapped = _guess_channels(more, geometry)[0]
        lines += [*_run_lines(file, geometry), *difference_lines(file, "channels", mapped, more_mapped, channel_line)]
        if _kind(file.path) in (None, *KINDS_WITH_LOADS):
            lines += difference_lines(file, "loads", _needed_loads(file, loads), more_loads, _load_line)
    return "\n".join(lines) + "\n"


def _needed_loads(file: ForeignFile, loads: Entries) -> Entries:
    """The loads that a file must have: of a sweep those that its name says are excited, where it says so."""
    excited = _excited(file.path) if _kind(file.path) == "sweep" else UNFINISHED
    return {name: entry for name, entry in loads.items() if excited in (UNFINISHED, entry[1])}


def _is_tachometer(channel: ForeignChannel) -> bool:
    """Whether a channel has the name of a tachometer, and is no speed in rpm or Hz."""
    has_name = bool(TACHOMETER.search(channel.signal)) and not NO_ROTOR.search(channel.signal)
    return has_name and unit_of(channel.unit, FREQUENCY) is None


def _of_other_length(file: ForeignFile, time: ForeignChannel | None) -> list[ForeignChannel]:
    """Return the channels that the times of a file cannot belong to: spectra and correlations beside a record."""
    rows = [group for group in file.groups if any(channel is time for channel in group.channels)]
    groups = [group for group in file.groups if rows and group.rate is None and group.time is None]
    # Channels of a lower rate have samples in every so many rows of the times.
    return [
        channel
        for group in groups
        if group.stride == 1 and group.samples != rows[0].samples
        for channel in group.channels
    ]


def _require_signals(file: ForeignFile, channels: Sequence[ForeignChannel], time: ForeignChannel | None) -> None:
    """Raise UserError where a file has nothing beside its time that can be imported."""
    if any(channel is not time for channel in channels):
        return
    unusable = next((group for group in file.groups if group.unusable), None)
    what = f": `{unusable.names[0]}` is {unusable.unusable}" if unusable is not None else ""
    is_response = unusable is not None and FREQUENCY_RESPONSE in unusable.unusable
    remedy = "Import responses by `balance import-frf`, or export" if is_response else "Export"
    raise UserError(f"has no records of samples in time{what}", str(file.path), remedy=f"{remedy} the time records")


def _rig(geometry: Geometry | None) -> str:
    return quoted(geometry.rig) if geometry is not None else "TODO  # as in the geometry"


def _file_comments(files: Sequence[ForeignFile]) -> Iterator[str]:
    for file in files:
        count = sum(len(group.channels) for group in file.groups)
        yield f"# {file.path.name}: {file.format}, {count} channels"
        yield from (f"#   {note}" for note in file.notes)
        if file.labels:
            yield f"#   columns of text: {', '.join(file.labels)}"
        for group in file.groups:
            if group.unusable:
                yield f"#   not usable: {', '.join(group.names[:5])}: {group.unusable}"


def _guess_channels(
    channels: Sequence[ForeignChannel], geometry: Geometry | None
) -> tuple[dict[str, tuple[ForeignChannel, str]], list[str]]:
    """The channels with the names that they seem to have in the geometry, and those of its names that are left."""
    free = list(geometry.channel_names) if geometry is not None else []
    mapped: dict[str, tuple[ForeignChannel, str]] = {}
    for channel in channels:
        match = _nearest(channel.signal, free) or _nearest(channel.signal.rpartition("/")[2], free)
        if match:
            free.remove(match)
        mapped.setdefault(channel.name, (channel, match or (UNFINISHED if geometry is not None else channel.signal)))
    return mapped, free


def _channel_line(geometry: Geometry | None, channel: ForeignChannel, target: str) -> str:
    declared = geometry.reading_units([target]) if geometry is not None else {}
    is_reading = not channel.unit or bool(unit_of(channel.unit, declared.get(target, "V")))
    unit, comment = channel.unit or UNFINISHED, "" if channel.unit else "  # the file states no unit: V, mV ..."
    if not is_reading:
        unit, comment = _scaled_unit(channel)
    entry = [f"name: {quoted(target)}", f"unit: {quoted(unit)}"]
    entry += [] if is_reading and not channel.scale else ["scale: TODO"]
    if channel.scale:
        comment = f"  # integers: the file states {channel.scale}, which are not applied"
    if channel.is_raw:
        comment = f"  # raw values: {channel.scale} cannot be applied"
    return f"  {quoted(channel.key)}: {{{', '.join(entry)}}}{comment}"


def _scaled_unit(channel: ForeignChannel) -> tuple[str, str]:
    """The unit of a channel that is not in volts, and a comment that says for what its `scale` is."""
    text = channel.unit.strip()
    if text == "g" and WEIGHT_NAME.search(channel.signal):
        return WEIGHT_UNIT, "  # the file says g, a weight here; scale: volts for one N, or remove it"
    unit = unit_of(text, ACCELERATION) if text == "g" else unit_of(text)
    if unit is None:
        return "V", f"  # the file says {text}; scale: volts for one {text}, or remove it"
    if unit.dimension == NUMBER:
        return text, "  # volts for a value of 1, none where the geometry declares counts, or remove it"
    return text, f"  # volts for one {unit.dimension}, or remove it"


def _nearest(name: str, names: Sequence[str]) -> str | None:
    plain = {re.sub(r"\W|_", "", known.lower()): known for known in names}
    match = difflib.get_close_matches(re.sub(r"\W|_", "", name.lower()), plain, n=1, cutoff=SIMILARITY)
    return plain[match[0]] if match else None


def _load_line(channel: ForeignChannel, component: str) -> str:
    unit = channel.unit or ("N" if component.startswith("F") else "N m")
    comment = "  # TODO: check the sign" if channel.unit else "  # TODO: check unit and sign"
    return f"  {quoted(channel.key)}: {{component: {component}, unit: {quoted(unit)}, sign: 1}}{comment}"


def _rotor_lines(tachometer: ForeignChannel | None, geometry: Geometry | None) -> Iterator[str]:
    mark = "" if tachometer is not None else "# "
    name = quoted(tachometer.key) if tachometer is not None else "TACHOMETER"
    yield f"{mark}rotor:"
    yield f"{mark}  channel: {name}"
    yield from _pulse_lines(tachometer, mark)
    declared = geometry.acquisition.filter if geometry is not None else None
    if declared is not None:
        text = f"filter: {{order: {declared.order}, cutoff: {declared.cutoff:g}}}"
        yield f"{mark}  # {text}  # TODO: where the tachometer passes the anti-alias filter, too"


def _pulse_lines(tachometer: ForeignChannel | None, mark: str) -> Iterator[str]:
    """Yield how a revolution is found: by pulses, or by the angle that the unit or the name of the channel states."""
    unit = unit_of(tachometer.unit, ANGLE) if tachometer is not None else None
    is_angle = tachometer is not None and not tachometer.unit and ANGLE_NAME.search(tachometer.signal)
    if unit is None and not is_angle:
        yield f"{mark}  pulses_per_revolution: 1"
        return
    counts = 2 * math.pi / unit.factor if unit is not None else 360.0
    yield f"{mark}  kind: counts"
    yield f"{mark}  counts_per_revolution: {counts:.15g}" + ("" if unit is not None else "  # TODO: check the unit")


def _run_lines(file: ForeignFile, geometry: Geometry | None) -> Iterator[str]:
    kind = _kind(file.path)
    yield f"  - file: {quoted(file.path.name)}"
    yield '    run: "{stem}"'
    yield f"    kind: {kind or 'TODO  # static, zero, sweep, check or wind'}"
    if kind == "static":
        yield "    trim: TODO  # label of the trim condition"
    elif kind == "sweep":
        yield f"    excited: {_excited(file.path)}"
        yield "    excitation: TODO  # multisine, random, sine-sweep, stepped or impact"
        yield "    # period: seconds of a multisine; level: rms in N or N m, by default that of the record"
    elif kind in ("check", "wind") and geometry is not None and geometry.rotor is not None:
        yield f"    rotor_speed: {geometry.rotor.speed:g}  # Hz, nominal"


def _excited(path: Path) -> str:
    """The component in the name of a file."""
    words = re.split(r"[^a-z]+", path.stem.lower())
    return next((name for name in COMPONENTS if name.lower() in words), UNFINISHED)


def _kind(path: Path) -> str | None:
    stem = path.stem.lower()
    return next(
        (kind for kind, words in KIND_NAMES.items() if re.search(rf"(?<![a-z])({'|'.join(words)})", stem)), None
    )
