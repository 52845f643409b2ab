"""Universal file format: datasets 58 (text) and 58b (binary), as written by test systems.

Source: Structural Dynamics Research Corporation, "Universal File Datasets Summary", dataset 58 (function at nodal DOF).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from balance_cli.importers.base import Array, ChannelGroup, ForeignChannel, ForeignFile, TextLayout, damage_error
from balance_cli.importers.uff_numbers import TextNumbers, binary_numbers
from balance_cli.importers.written_numbers import plausible_rate
from balance_cli.io.errors import UserError

NAME = "UFF 58"
DELIMITER = b"-1"
HEADER_LINES = 11
"""Records 1 to 11 before the data, whatever the 58b line says."""
LONGEST_LINE = 4096
"""Bytes; a header line has 80. Longer ones are binary data."""

FUNCTION_TYPES = (
    *("a general function", "a time response", "an auto spectrum", "a cross spectrum", "a frequency response"),
    *("a transmissibility", "a coherence", "an autocorrelation", "a cross-correlation", "a power spectral density"),
    *("an energy spectral density", "a probability density", "a spectrum", "a cumulative frequency distribution"),
    *("a peaks valley", "a stress cycle", "a strain cycle", "an orbit", "a mode indicator function"),
    *("a force pattern", "a partial power", "a partial coherence", "an eigenvalue", "an eigenvector"),
    *("a shock response spectrum", "a finite impulse response filter", "a multiple coherence", "an order function"),
)
"""Names of the function types 0 to 27."""
TIME_RESPONSE = 1
TIME_ABSCISSA = 17
GENERAL_FUNCTION = 0
DIRECTIONS = {1: "+X", -1: "-X", 2: "+Y", -2: "-Y", 3: "+Z", -3: "-Z", 4: "+RX", -4: "-RX"} | {
    5: "+RY",
    -5: "-RY",
    6: "+RZ",
    -6: "-RZ",
}


@dataclass(frozen=True)
class Layout58:
    """Where the numbers of a dataset are: a byte order (`<`, `>`, or empty for text), first byte and count of bytes."""

    order: str
    offset: int
    size: int


def sniff(path: Path, head: bytes) -> bool:
    """Whether the first line that is not empty is the delimiter, and a number of a dataset follows."""
    lines = [line.strip() for line in head[:LONGEST_LINE].splitlines() if line.strip()]
    return len(lines) > 1 and lines[0] == DELIMITER and re.match(rb"^\d+b?(\s|$)", lines[1]) is not None


def open_file(path: Path, layout: TextLayout) -> ForeignFile:
    """Open the datasets 58 of a file; others are listed in the notes."""
    groups, notes, recorded, others = [], [], None, []
    with path.open("rb") as file:
        for number, kind, header, where in datasets(file, path.stat().st_size):
            if not kind.startswith("58"):
                others.append(kind)
                continue
            group, group_notes = _group(path, header, where, number)
            recorded = recorded or _recorded(header)
            groups.append(group)
            notes += group_notes
    if others:
        notes.append(f"datasets of other types were not read: {', '.join(sorted(set(others)))}")
    if not groups:
        raise UserError("holds no dataset 58", remedy="Export the time records as dataset 58 or 58b")
    return ForeignFile(path, NAME, tuple(groups), tuple(dict.fromkeys(notes)), recorded)


def datasets(file: BinaryIO, size: int) -> Iterator[tuple[int, str, list[str], Layout58]]:
    """Yield number, type, header lines and place of the data of every dataset.

    Raises UserError where the file is damaged.
    """
    number = 0
    while (line := file.readline(LONGEST_LINE)) != b"":
        if line.strip() != DELIMITER:
            if line.strip(b"\r\n \t\0\x1a"):
                raise damage_error(f"no dataset begins at byte {file.tell() - len(line)}")
            continue
        kind_line = _next_line(file)
        if not kind_line:
            return
        number += 1
        words = kind_line.split()
        kind = words[0].lower()
        if kind not in ("58", "58b"):
            _skip_dataset(file)
            yield number, kind, [], Layout58("", 0, 0)
            continue
        header = [_header_line(file, number) for _ in range(HEADER_LINES)]
        where = _binary_place(file, words, header, size) if kind == "58b" else _text_place(file)
        if kind == "58b":
            _next_line(file)  # the delimiter that closes the dataset
        yield number, kind, header, where


def _next_line(file: BinaryIO) -> str:
    """The next line that is not empty, as text; stray carriage returns and padding removed."""
    while (line := file.readline(LONGEST_LINE)) != b"":
        if line.strip():
            return _text(line)
    return ""


def _header_line(file: BinaryIO, number: int) -> str:
    line = file.readline(LONGEST_LINE)
    if not line:
        raise damage_error(f"dataset {number} ends within its header")
    return _text(line)


def _text(line: bytes) -> str:
    """A header line in UTF-8 or else Latin-1, which test systems in Europe write."""
    line = line.rstrip(b"\r\n")
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError:
        return line.decode("latin-1")


def _skip_dataset(file: BinaryIO) -> None:
    while (line := file.readline(LONGEST_LINE)) != b"":
        if line.strip() == DELIMITER:
            return


def _text_place(file: BinaryIO) -> Layout58:
    offset = end = file.tell()
    while (line := file.readline(LONGEST_LINE)) != b"":
        if line.strip() == DELIMITER:
            return Layout58("", offset, end - offset)
        end = file.tell()
    raise damage_error("the last dataset has no end")


def _binary_place(file: BinaryIO, words: list[str], header: list[str], size: int) -> Layout58:
    """Where binary data are; the count of bytes follows from the data type, because some writers misstate it."""
    if len(words) < 5 or words[1] not in ("1", "2"):
        raise damage_error(f"the line `{' '.join(words)}` of a binary dataset")
    if words[2] != "2":
        raise UserError("holds numbers that are not IEEE 754", remedy="Export them in IEEE format, or as text")
    offset, order = file.tell(), "<" if words[1] == "1" else ">"
    needed = data_form(header).bytes_needed
    stated = int(words[4]) if words[4].isascii() and words[4].isdecimal() else needed
    for count in dict.fromkeys((needed, stated)):
        if count >= needed and offset + count <= size and _ends_at(file, offset + count):
            return Layout58(order, offset, needed)
    raise damage_error(f"binary data of {needed} bytes from byte {offset} do not end with a delimiter")


def _ends_at(file: BinaryIO, end: int) -> bool:
    """Whether the delimiter stands at byte `end`; if so, leave the file there."""
    file.seek(end)
    is_delimiter = file.read(32).lstrip(b"\r\n \t").startswith(DELIMITER)
    file.seek(end)
    return is_delimiter


@dataclass(frozen=True)
class DataForm:
    """Records 6 and 7: function type, type of the numbers, their count and abscissa."""

    function: int
    kind: int
    count: int
    is_even: bool
    first: float
    increment: str

    @property
    def is_double(self) -> bool:
        """Whether ordinates are double precision."""
        return self.kind in (4, 6)

    @property
    def is_complex(self) -> bool:
        """Whether ordinates are complex."""
        return self.kind in (5, 6)

    @property
    def bytes_needed(self) -> int:
        """Bytes of the binary data; an uneven abscissa is single precision with single precision ordinates."""
        ordinate = (8 if self.is_double else 4) * (2 if self.is_complex else 1)
        return self.count * (ordinate + (0 if self.is_even else 8 if self.is_double else 4))


def data_form(header: list[str]) -> DataForm:
    """Return what records 6 and 7 say. Raises UserError where they cannot be read."""
    try:
        fields = header[6].replace("D", "E").split()
        function = int(header[5][:5])
        return DataForm(function, int(fields[0]), int(fields[1]), int(fields[2]) == 1, float(fields[3]), fields[4])
    except (ValueError, IndexError) as error:
        raise damage_error(f"records 6 and 7 `{' / '.join(line.strip() for line in header[5:7])[:100]}`") from error


def _group(path: Path, header: list[str], where: Layout58, number: int) -> tuple[ChannelGroup, list[str]]:
    form = data_form(header)
    label, unit = split_axis(header[8])
    channel = ForeignChannel(_channel_name(header, label, number), unit)
    unusable = _unusable(form, header)
    rate, notes = None, []
    if not unusable:
        rate, note = _rate(form, number)
        notes = [f"dataset {number}: {note}"] if note else []
    numbers = binary_numbers(path, where.order, where.offset, form) if where.order else TextNumbers(path, where, form)

    def read(columns: Sequence[int], start: int, stop: int) -> Array:
        return np.repeat(numbers.read(start, stop)[:, None], len(columns), axis=1)

    return ChannelGroup((channel,), form.count, read, rate, form.first, unusable), notes


def _rate(form: DataForm, number: int) -> tuple[float, str]:
    try:
        return plausible_rate(form.increment)
    except (ValueError, ZeroDivisionError) as error:
        raise damage_error(f"dataset {number} has the time step {form.increment}") from error


def _unusable(form: DataForm, header: list[str]) -> str:
    abscissa = header[7][:10].strip()
    in_time = form.function == TIME_RESPONSE or (
        form.function == GENERAL_FUNCTION and abscissa.isdigit() and int(abscissa) == TIME_ABSCISSA
    )
    if not in_time:
        known = 0 <= form.function < len(FUNCTION_TYPES)
        return f"{FUNCTION_TYPES[form.function] if known else f'a function of type {form.function}'}, not a time record"
    if form.is_complex:
        return "a complex time record"
    return "" if form.is_even else "a time record with uneven steps"


def _channel_name(header: list[str], label: str, number: int) -> str:
    """Entity with node and direction of the response, else the first words of the header, else the axis label."""
    entity, node, direction = header[5][31:41].strip(), header[5][41:51].strip(), header[5][51:55].strip()
    place = f"{node}{DIRECTIONS.get(int(direction), '') if direction.lstrip('-').isdigit() else ''}"
    if entity and entity != "NONE":
        return entity if place in ("", "0") or entity.endswith(place) else f"{entity}:{place}"
    title = header[0].strip()
    if title and title != "NONE":
        return title
    if place not in ("", "0"):
        return place
    return label if label and label != "NONE" else f"dataset {number}"


def split_axis(line: str) -> tuple[str, str]:
    """Return label and unit of an axis record (I10, 3I5, 2(1X, 20A1))."""
    label, unit = line[25:46].strip(), line[46:67].strip()
    return label, "" if unit == "NONE" else unit


def _recorded(header: list[str]) -> str | None:
    import datetime

    text = header[2].strip()
    for pattern in ("%d-%b-%y %H:%M:%S", "%d-%b-%Y %H:%M:%S"):
        try:
            return datetime.datetime.strptime(text, pattern).isoformat()
        except ValueError:
            continue
    return None
