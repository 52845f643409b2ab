"""What a file has otherwise than the one that a sketched map was made of: lines of its entry of `runs`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

from balance_cli.importers.base import ForeignChannel, ForeignFile
from balance_cli.steps.sketched_rates import quoted
from balance_cli.steps.sketched_times import empty_times, time_channel

Entries = Mapping[str, tuple[ForeignChannel, str]]
"""Of each channel in the map: the channel, and the name or component that it has there."""


def base_file(files: Sequence[ForeignFile]) -> ForeignFile:
    """The file with most channels, without the names of groups where another file has the same channels without them.

    LabVIEW writes a tachometer into a group of its own, and records without one have a single group.
    """
    base = max(files, key=lambda file: len(_names(file)))
    plain = {name for file in files if file is not base for name in _names(file)}
    counts = Counter(name.rpartition("/")[2] for name in _names(base))

    def shown(channel: ForeignChannel) -> ForeignChannel:
        last = channel.name.rpartition("/")[2]
        return replace(channel, name=last) if last in plain and counts[last] == 1 else channel

    groups = tuple(replace(group, channels=tuple(map(shown, group.channels))) for group in base.groups)
    return replace(base, groups=groups)


def _names(file: ForeignFile) -> list[str]:
    return [channel.name for group in file.groups if not group.unusable for channel in group.channels]


def own_channels(file: ForeignFile, base: ForeignFile) -> list[ForeignChannel]:
    """Return the channels of a file that the base file of the map lacks, without its times."""
    known = {name.rpartition("/")[2] for name in _names(base)}
    times = [group.channels[group.time] for group in file.groups if group.time is not None]
    times += [time for time in (time_channel(file), *empty_times(file)) if time is not None]
    channels = [channel for group in file.groups if not group.unusable for channel in group.channels]
    ours = [channel for channel in channels if channel.name.rpartition("/")[2] not in known]
    return [channel for channel in ours if not any(channel is time for time in times)]


def difference_lines(
    file: ForeignFile,
    field: str,
    entries: Entries,
    own_entries: Entries,
    entry_line: Callable[[ForeignChannel, str], str],
) -> Iterator[str]:
    """Yield the lines of `field` (channels or loads) of the entry of a file.

    Channels that the file does not have are null; those that it states in another unit, and those that it alone has,
    have an entry of their own.
    """
    channels = [channel for group in file.groups if not group.unusable for channel in group.channels]
    own = {channel.name.rpartition("/")[2]: channel for channel in channels}
    own |= {channel.name: channel for channel in channels}
    lines = []
    for name, (channel, target) in entries.items():
        if name not in own:
            lines.append(f"  {quoted(channel.key)}: null  # not in this file")
        elif own[name].unit.strip() != channel.unit.strip():
            lines.append(entry_line(replace(own[name], ordinal=channel.ordinal), target))
    lines += [entry_line(*entry) for entry in own_entries.values()]
    if lines:
        yield f"    {field}:  # in place of those above"
        yield from (f"    {line}" for line in lines)
