"""Times among the channels of a file of another program, for the sketch of a map."""

from __future__ import annotations

import re

import numpy as np

from balance_cli.importers.base import ChannelGroup, ForeignChannel, ForeignFile
from balance_cli.importers.time_axis import TimeAxis, read_time_axis
from balance_cli.importers.time_columns import TIME_NAME
from balance_cli.io.errors import UserError
from balance_cli.io.units import TIME, Unit, can_be_unit_of, is_unit, parse_unit

TIME_NAMES = {"time", "t", "zeit", "times", "timestamp", "date/time", "uhrzeit", "elapsed time", "x_value"}
TIME_NAMES |= {"millis", "micros"}
UNNAMED = re.compile(r"column \d+|X", re.IGNORECASE)
"""First column of a text without names, or with that of an abscissa."""
TIMES_READ = 4096
"""Samples of a column of times from which its step is told."""


def _last_name(channel: ForeignChannel) -> str:
    """The name in lower case, without those of the structures that hold it, numbers and unit."""
    return re.sub(r"\[\d+\]$", "", channel.signal.lower()).rpartition(".")[2]


def time_channel(file: ForeignFile) -> ForeignChannel | None:
    """Return the first channel with the name of a time, and with a value; one in a unit of time before others."""
    found = [
        (channel, group, column)
        for group in file.groups
        for column, channel in enumerate(group.channels)
        if not group.unusable and _names_time(channel, column, group.rate is not None)
        if group.samples and np.isfinite(group.read([column], 0, 1)).all()
    ]
    if len(found) < 2:
        return found[0][0] if found else None

    def rank(candidate: tuple[ForeignChannel, ChannelGroup, int]) -> tuple[bool, bool, bool]:
        channel, group, column = candidate
        # A thrust or a torque is called `T`, too; the times at which a computer got the samples are uneven.
        unit = parse_unit(channel.unit, TIME).factor if _in_unit_of_time(channel) else 1.0
        is_even = group.rate is not None or time_axis(group, column, unit) is not None
        return not _in_unit_of_time(channel), not is_even, len(_last_name(channel)) == 1

    return min(found, key=rank)[0]


def _in_unit_of_time(channel: ForeignChannel) -> bool:
    return bool(channel.unit) and can_be_unit_of(channel.unit, TIME)


def _names_time(channel: ForeignChannel, column: int, has_rate: bool) -> bool:
    """Whether a channel has the name of a time, or two of: a name that begins so, a unit of time, the first column.

    Oscilloscopes call their times `X`, in `Second`. No time is what is stated in another unit, or beside the rate of
    its samples in none.
    """
    has_unit = _in_unit_of_time(channel)
    if not has_unit and (has_rate or is_unit(channel.unit)):
        return False
    if _last_name(channel) in TIME_NAMES:
        return True
    if column == 0 and has_unit:
        return True
    return bool(TIME_NAME.match(channel.name)) and (has_unit or (not channel.unit and column == 0))


def empty_times(file: ForeignFile) -> list[ForeignChannel]:
    """Return the channels with the name of a time and without a value: LabVIEW writes an empty `X_Value`."""
    return [
        channel
        for group in file.groups
        for column, channel in enumerate(group.channels)
        if _last_name(channel) in TIME_NAMES and not group.unusable and group.samples
        if np.isnan(group.read([column], 0, 1)).all()
    ]


def even_column(file: ForeignFile) -> ForeignChannel | None:
    """Return the first of columns without names that holds even times, but no numbers of rows."""
    group = file.groups[0]
    if group.rate is not None or group.unusable or not UNNAMED.fullmatch(group.names[0]):
        return None
    for column in range(min(2, len(group.channels))):
        axis = time_axis(group, column)
        if axis is None:
            return None
        if axis.rate != 1.0 or axis.start not in (0.0, 1.0):
            return group.channels[column]
    return None


def time_axis(group: ChannelGroup, column: int, factor: float = 1.0) -> TimeAxis | None:
    """Return the even times at the beginning of a column, of which `factor` makes seconds; None where they are not."""
    count = min(group.samples, TIMES_READ)
    try:
        return read_time_axis(lambda _, first, last: group.read([column], first, last), count, factor)
    except UserError:
        return None


def unit_of(text: str, *dimensions: str) -> Unit | None:
    """Return the unit of one of the dimensions that a text names; None where it names none."""
    try:
        return parse_unit(text, *dimensions) if text else None
    except UserError:
        return None
