"""What every format gives: the channels of a file, in groups that were sampled together, read in blocks."""

from __future__ import annotations

import importlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from balance_cli.io.errors import UserError

Array = NDArray[np.float64]
ReadBlock = Callable[[Sequence[int], int, int], Array]
"""`read(columns, start, stop)` returns samples start to stop (stop - start, len(columns)) as float64."""

SNIFFED_BYTES = 65536
"""Bytes at the start of a file by which its format is recognized."""


@dataclass(frozen=True)
class ForeignChannel:
    """A channel as its file names it; `unit` is empty where the file states none.

    `label`: what the file calls the signal, where `name` is the place of its samples (`rec.Y[3].Data`); else empty.
    `ordinal`: which of several channels of one name in the file it is, from 1; 0 where it is the only one.
    `scale`: numbers beside integers that may convert them (`gain 0.01, offset 1`), and are not applied; else empty.
    `is_raw`: the values are those before a scale of the format that cannot be applied, which `scale` names.
    """

    name: str
    unit: str = ""
    label: str = ""
    scale: str = ""
    is_raw: bool = False
    ordinal: int = 0

    @property
    def key(self) -> str:
        """What a map calls it, also where others have its name."""
        return f"{self.name} #1" if self.ordinal == 1 else self.name

    @property
    def signal(self) -> str:
        """What the signal is called."""
        return self.label or self.name


@dataclass(frozen=True)
class ChannelGroup:
    """Channels that were sampled together.

    `rate` [Hz] is None where the file states none (a time column may). `start` [s] is the time of the first sample on
    the clock of the file. A group of a lower rate that shares the rows of a time column with others has its samples at
    row `first_row` of them and every `stride` rows from there. `time` is the channel (its index) that holds the times
    of this group, in a file with several. `unusable` says why the group is no record of samples in time (a spectrum,
    text), else empty.
    """

    channels: tuple[ForeignChannel, ...]
    samples: int
    read: ReadBlock = field(repr=False)
    rate: float | None = None
    start: float = 0.0
    unusable: str = ""
    first_row: int = 0
    stride: int = 1
    time: int | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the channels."""
        return tuple(channel.name for channel in self.channels)


@dataclass(frozen=True)
class ForeignFile:
    """An opened file of another program: its groups of channels, and `notes` on what was assumed in reading it.

    `scalars` are single numbers that stand beside the channels, such as a sample rate. `labels` read columns of text by
    name, one for each sample.
    """

    path: Path
    format: str
    groups: tuple[ChannelGroup, ...]
    notes: tuple[str, ...] = ()
    recorded: str | None = None
    scalars: dict[str, float] = field(default_factory=dict)
    labels: dict[str, Callable[[], tuple[str, ...]]] = field(default_factory=dict, repr=False)


@dataclass(frozen=True)
class TextLayout:
    """How a text file is to be read, where it is not to be found out; rows count from 1."""

    separator: str | None = None
    decimal: str | None = None
    name_row: int | None = None
    unit_row: int | None = None
    first_row: int | None = None
    encoding: str | None = None


COMPRESSION_TESTED = 2**28
"""Bytes of samples from which their compression is tested; fewer are read in no time."""
LARGEST_COMPRESSION = 200.0
"""Ratio of declared to stored bytes. One bit of noise a sample, in numbers of 64, allows 64; constants give 1000."""


class Format(Protocol):
    """A file format: a module of this package."""

    NAME: str

    def sniff(self, path: Path, head: bytes) -> bool:
        """Whether a file that begins with `head` is of this format."""
        ...

    def open_file(self, path: Path, layout: TextLayout) -> ForeignFile:
        """Open it. Raises UserError, without the file's name, where it is damaged."""
        ...


def distinct_names(groups: Sequence[ChannelGroup]) -> tuple[ChannelGroup, ...]:
    """The groups with repeated channel names told apart by `#2`, `#3` and so on, and empty ones numbered."""
    plain = [[" ".join(channel.name.split()) or "channel" for channel in group.channels] for group in groups]
    counts = Counter(name for names in plain for name in names)
    before: Counter[str] = Counter()
    renamed = []
    for group, names in zip(groups, plain, strict=True):
        channels = []
        for channel, name in zip(group.channels, names, strict=True):
            before[name] += 1
            ordinal = before[name] if counts[name] > 1 else 0
            channels.append(replace(channel, name=f"{name} #{ordinal}" if ordinal > 1 else name, ordinal=ordinal))
        renamed.append(replace(group, channels=tuple(channels)))
    return tuple(renamed)


def as_numbers(values: Any) -> Array:
    """Return values as numbers: time stamps as seconds from 1970, durations as seconds."""
    array = np.asarray(values)
    array = array - np.datetime64(0, "s") if array.dtype.kind == "M" else array
    return np.asarray(array / np.timedelta64(1, "s") if array.dtype.kind == "m" else array, np.float64)


def impossible_size(path: Path, samples: int, channels: int) -> str:
    """Return why a file cannot hold what a group declares, as `unusable` of the group; empty where it can."""
    declared, stored = 8 * samples * channels, path.stat().st_size
    if 0 <= declared <= max(COMPRESSION_TESTED, LARGEST_COMPRESSION * stored):
        return ""
    return f"damaged: {samples} samples of {channels} channels are declared in {stored} bytes"


def require_package(module: str, format_name: str, package: str) -> Any:
    """The module that reads a format. Raises UserError, with what to install, where it is absent."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        remedy = f"Install it: pip install {package}"
        fault = f"is {format_name}, and the package `{package}` that reads it is not installed"
        raise UserError(fault, remedy=remedy) from error


@contextmanager
def errors_as_damage(path: Path | None = None, place: str = "") -> Iterator[None]:
    """Turn what a foreign reader raises into the error of a damaged file: it raises whatever damaged bytes lead to."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        raise damage_error(error).with_location(file="" if path is None else str(path), place=place) from error


def damage_error(reason: object) -> UserError:
    """The error of a file whose content ends early or contradicts itself."""
    text = " ".join(str(reason).split())[:200]
    return UserError(f"cannot be read, it is truncated or damaged ({text})", remedy="Copy or export it again")


def select_columns(table: NDArray[Any], columns: Sequence[int]) -> Array:
    """Return columns of a table (n, c) in double precision, as a copy; all together are not picked one by one."""
    indices = list(columns)
    return np.array(table if indices == list(range(table.shape[1])) else table[:, indices], np.float64)
