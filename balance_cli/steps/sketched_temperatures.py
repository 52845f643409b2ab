"""Temperatures among the channels of a sketch."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from balance_cli.importers.base import ForeignChannel, ForeignFile
from balance_cli.io.units import TEMPERATURE, can_be_unit_of
from balance_cli.steps.sketched_rates import quoted
from balance_cli.steps.sketched_times import unit_of

TEMPERATURE_NAME = re.compile(r"temp|therm|^t[_\W\d]|^t[a-z]$", re.IGNORECASE)
"""Names of temperatures; `C` and `K` beside other names are charges and factors."""


def guess_temperatures(
    channels: Sequence[ForeignChannel], files: Sequence[ForeignFile]
) -> tuple[list[ForeignChannel], list[ForeignChannel]]:
    """Return the channels in a unit of temperature that all files have, and the others."""
    names = [{name for group in file.groups for name in group.names} for file in files]
    found = [each for each in channels if _is_temperature(each) and all(each.name in known for known in names)]
    return found, [channel for channel in channels if channel not in found]


def _is_temperature(channel: ForeignChannel) -> bool:
    unit = unit_of(channel.unit)
    if unit is not None and unit.dimension == TEMPERATURE and len(channel.unit.strip()) > 1:
        return True
    return can_be_unit_of(channel.unit, TEMPERATURE) and bool(TEMPERATURE_NAME.search(channel.signal))


def temperature_lines(channels: Sequence[ForeignChannel]) -> Iterator[str]:
    """Yield the entry of the temperatures of a map; nothing without any."""
    if channels:
        yield "temperature:"
    for channel in channels:
        unit = channel.unit if unit_of(channel.unit) is not None else f"deg{channel.unit.strip().upper()}"
        yield f"  {quoted(channel.key)}: {{name: {quoted(channel.signal)}, unit: {quoted(unit)}}}"
