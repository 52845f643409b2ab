"""What a file has otherwise than the one that a sketched map was made of: lines of its entry of `runs`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from balance_cli.importers.base import ForeignChannel, ForeignFile

Entries = Mapping[str, tuple[ForeignChannel, str]]
"""Of each channel in the map: the channel, and the name or component that it has there."""


def difference_lines(
    file: ForeignFile, field: str, entries: Entries, entry_line: Callable[[ForeignChannel, str], str]
) -> Iterator[str]:
    """Yield the lines of `field` (channels or loads) of the entry of a file.

    Channels that the file does not have are null, and those that it states in another unit have an entry of their own.
    """
    own = {channel.name: channel for group in file.groups if not group.unusable for channel in group.channels}
    lines = []
    for name, (channel, target) in entries.items():
        if name not in own:
            lines.append(f"{entry_line(channel, target).partition(':')[0]}: null  # not in this file")
        elif own[name].unit.strip() != channel.unit.strip():
            lines.append(entry_line(own[name], target))
    if lines:
        yield f"    {field}:  # in place of those above"
        yield from (f"    {line}" for line in lines)
