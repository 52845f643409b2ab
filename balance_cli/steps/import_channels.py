"""Channels in the files of one run, found by the names that a map gives them."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence, Set
from dataclasses import dataclass
from fnmatch import fnmatch

from balance_cli.importers.base import ChannelGroup, ForeignFile
from balance_cli.io.errors import UserError

MOST_SHOWN = 5
"""Names in a message."""
FIRST = " #1"
"""Behind the name of the first of several channels that are called alike."""
SPECTRUM_WORDS = re.compile(r"\b(FFT|PSD|ASD|FRF|(auto|cross|power)?[- ]?spectr(um|al)\w*|spektrum)\b", re.IGNORECASE)
"""Names of what analyzers export beside records, with frequencies in a column that may be called time."""


@dataclass(frozen=True)
class FoundChannel:
    """A channel of a file: its group and column."""

    name: str
    file: ForeignFile
    group: ChannelGroup
    column: int

    @property
    def unit(self) -> str:
        """The unit that the file states, empty where it states none."""
        return self.group.channels[self.column].unit

    @property
    def scale(self) -> str:
        """The scale that the file states and that is not applied, empty where there is none."""
        return self.group.channels[self.column].scale

    @property
    def is_raw(self) -> bool:
        """Whether the values are raw, before a scale that cannot be applied."""
        return self.group.channels[self.column].is_raw

    @property
    def ordinal(self) -> int:
        """Which of several channels with this name it is, from 1; 0 where it is the only one."""
        return self.group.channels[self.column].ordinal


class ChannelNames:
    """The channels of the files of one run, by name; `used` are the names in the map."""

    def __init__(self, files: Sequence[ForeignFile], used: Set[str]) -> None:
        self.files = files
        self._used = used
        self._channels: dict[str, FoundChannel] = {}
        for file in self.files:
            for group in file.groups:
                for column, channel in enumerate(group.channels):
                    self._add(FoundChannel(channel.name, file, group, column))

    def _add(self, channel: FoundChannel) -> None:
        first = self._channels.setdefault(channel.name, channel)
        if first is not channel and channel.name in self._used:
            fault = f"has the channel `{channel.name}`, which {first.file.path} has, too"
            remedy = (
                f"Give these files different run names, or write `{channel.file.path.name}/{channel.name}`; of pieces "
                "of one record the times must go on from file to file"
            )
            raise UserError(fault, str(channel.file.path), remedy=remedy)

    def namesakes(self, channel: FoundChannel) -> list[FoundChannel]:
        """Channels of the same name in other files of the run."""
        return [
            FoundChannel(channel.name, file, group, group.names.index(channel.name))
            for file in self.files
            if file is not channel.file
            for group in file.groups
            if channel.name in group.names and not group.unusable
        ]

    def find(self, name: str) -> FoundChannel:
        """The channel of this name, or of one file as `FILE/CHANNEL`; `*` and `?` in FILE stand for any characters.

        Raises UserError, with the nearest one, where there is none or it is unusable.
        """
        key = " ".join(name.split())
        channel = self._named(name)
        file = str(self.files[0].path)
        if channel is None:
            self._require_one_group(key)
            near = difflib.get_close_matches(key, self._channels, n=1, cutoff=0.0)
            count = len(self._channels)
            remedy = f"The nearest of its {count} channels is `{near[0]}`" if near else "It has no channels"
            remedy += f"; `{name}: null` in the entry of `runs` leaves it out"
            raise UserError(f"has no channel `{name}`, which the map names", file, remedy=remedy)
        self._require_one_meaning(name, channel)
        if channel.group.unusable:
            fault = f"is {channel.group.unusable}"
            raise UserError(fault, str(channel.file.path), f"channel `{name}`", "Leave it out of the map")
        if SPECTRUM_WORDS.search(f"{channel.name} {channel.unit}"):
            fault = "seems to be a spectrum, and no record in time"
            remedy = "Export the samples in time, or rename the channel in the file if it is one"
            raise UserError(fault, str(channel.file.path), f"channel `{name}`", remedy)
        return channel

    def _require_one_meaning(self, name: str, channel: FoundChannel) -> None:
        """Raise UserError, with the places, where a name without a number is that of several channels of a file.

        A map that names another one of them, such as `F1 #2`, knows of them.
        """
        places = _places(channel)
        known = {used for name in (*self._used, name) for used in (name, name.partition("/")[2])}
        if len(places) < 2 or known & set(places):
            return
        fault = f"has {len(places)} channels of this name: {', '.join(f'`{key}` ({at})' for key, at in places.items())}"
        raise UserError(fault, str(channel.file.path), f"channel `{name}`", "Write one of these names in the map")

    def _require_one_group(self, key: str) -> None:
        """Raise UserError, with their whole names, where channels of several groups have this name."""
        names = [channel.name for channel in self._in_groups(key)]
        if len(names) > 1:
            fault = f"has {len(names)} channels of this name: {', '.join(f'`{name}`' for name in names[:MOST_SHOWN])}"
            remedy = "Write one of these names in the map"
            raise UserError(fault, str(self.files[0].path), f"channel `{key}`", remedy)

    def has(self, name: str) -> bool:
        """Whether the files have a channel of this name, as `find` takes it, or several."""
        return self._named(name) is not None or bool(self._in_groups(" ".join(name.split())))

    def _named(self, name: str) -> FoundChannel | None:
        key = " ".join(name.split())
        keys = (key, key.removesuffix(FIRST))
        found = (look(k) for k in keys for look in (self._channels.get, self._find_in_file, self._find_in_group))
        return next((channel for channel in found if channel is not None), None)

    def _find_in_group(self, key: str) -> FoundChannel | None:
        """The only channel `GROUP/key`: a file with a second group, as of a tachometer, names the groups of all."""
        named = self._in_groups(key)
        return named[0] if len(named) == 1 else None

    def _in_groups(self, key: str) -> list[FoundChannel]:
        return [channel for name, channel in self._channels.items() if name.rpartition("/")[2] == key]

    def _find_in_file(self, key: str) -> FoundChannel | None:
        pattern, _, name = key.partition("/")
        for file in self.files:
            if fnmatch(file.path.name, pattern.strip()) or fnmatch(file.path.stem, pattern.strip()):
                for group in file.groups:
                    if name.strip() in group.names:
                        return FoundChannel(name.strip(), file, group, group.names.index(name.strip()))
        return None


def _places(channel: FoundChannel) -> dict[str, str]:
    """The usable channels with the name of this one in its file, by how a map names them, and where they are."""
    if channel.ordinal != 1:
        return {}
    several = len(channel.file.groups) > 1
    return {
        each.key: (f"group {g + 1}, " if several else "")
        + f"channel {k + 1}"
        + (f" in {each.unit}" if each.unit else "")
        for g, group in enumerate(channel.file.groups)
        for k, each in enumerate(group.channels)
        if each.ordinal and each.name in (channel.name, f"{channel.name} #{each.ordinal}") and not group.unusable
    }
