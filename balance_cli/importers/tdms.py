"""TDMS files of National Instruments, read by npTDMS."""

from __future__ import annotations

import re
import weakref
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from balance_cli.importers.base import (
    Array,
    ChannelGroup,
    ForeignChannel,
    ForeignFile,
    TextLayout,
    as_numbers,
    errors_as_damage,
    require_package,
)
from balance_cli.importers.stored_scales import stated_scale
from balance_cli.importers.written_numbers import whole_rate
from balance_cli.io.errors import UserError

NAME = "TDMS"
SCALE_TYPE = re.compile(r"NI_Scale\[(\d+)\]_Scale_Type")
SCALE_TYPES = frozenset(
    (
        *("Polynomial", "Linear", "RTD", "Strain", "Table", "Thermistor", "Thermocouple"),
        *("Add", "Subtract", "AdvancedAPI"),
    )
)
"""Types of scales that npTDMS 1.13 applies; where another is among the scales of a channel, it gives raw values."""
THERMOCOUPLE_LIMITS = {
    10047: (-50.0, 1820.0),
    10055: (-270.0, 1000.0),
    10072: (-210.0, 1200.0),
    10073: (-270.0, 1372.0),
    10077: (-270.0, 1300.0),
    10082: (-50.0, 1768.0),
    10085: (-50.0, 1768.0),
    10086: (-270.0, 400.0),
}
"""Temperatures [degC] between which the polynomials of ITS-90 hold, by the codes of National Instruments for the types
B, E, J, K, N, R, S and T: npTDMS extrapolates them, to -2e10 degC for an open input."""
LIMIT_MARGIN = 20.0
"""Temperature [K] beyond these limits that a polynomial of this degree still follows."""


def sniff(path: Path, head: bytes) -> bool:
    """Whether it begins with the tag of a segment."""
    return head[:4] == b"TDSm"


def open_file(path: Path, layout: TextLayout) -> ForeignFile:
    """List the channels; start times count from the earliest channel."""
    nptdms = require_package("nptdms", NAME, "npTDMS")
    with errors_as_damage(), nptdms.TdmsFile.open(path) as file:
        channels = [
            (group.name, channel.name, _facts(channel, _unknown_scale(channel, group, file)))
            for group in file.groups()
            for channel in group.channels()
        ]
        notes = ("the file ends early, within its last segment",) if file.file_status.incomplete_final_segment else ()
    if not channels:
        raise UserError("has no channels", remedy="Give a file with channels")
    begins = [facts["begin"] for _, _, facts in channels if facts["begin"] is not None]
    origin = min(begins, default=None)
    several = len({group for group, _, _ in channels}) > 1
    opened = _OpenFile(path)
    groups = tuple(_group(opened, group, name, facts, origin, several) for group, name, facts in channels)
    return ForeignFile(path, NAME, groups, notes, None if origin is None else str(origin)[:19])


def _unknown_scale(*holders: Any) -> str:
    """The type of a scale that npTDMS does not apply, and then leaves out all others; empty where it applies them.

    The scales are those of the first of the holders (channel, group, file) that has some.
    """
    for properties in (holder.properties for holder in holders):
        types = [str(value) for name, value in properties.items() if SCALE_TYPE.fullmatch(name)]
        if properties.get("NI_Number_Of_Scales", len(types)) and types:
            is_scaled = properties.get("NI_Scaling_Status") == "scaled"
            return next((kind for kind in types if kind not in SCALE_TYPES), "") if not is_scaled else ""
    return ""


def _facts(channel: Any, unknown_scale: str) -> dict[str, Any]:
    """Length, unit, step, start and type of a channel."""
    properties = channel.properties
    begin = properties.get("wf_start_time")
    step = properties.get("wf_increment")
    kind = np.dtype(channel.dtype).kind if channel.dtype is not None else ""
    return {
        "samples": len(channel),
        "unit": str(properties.get("unit_string", "") or ""),
        "rate": whole_rate(1.0 / float(step)) if step and float(step) > 0 else None,
        "begin": begin if isinstance(begin, np.datetime64) and _is_set(begin) else None,
        "offset": float(properties.get("wf_start_offset", 0.0) or 0.0),
        "kind": kind,
        # Scales of NI are applied in reading, which makes floating numbers of integers.
        "scale": stated_scale(_numbers(properties)) if kind in ("i", "u") else "",
        "unknown_scale": unknown_scale,
        "limits": _thermocouple_limits(properties),
    }


def _thermocouple_limits(properties: Mapping[str, Any]) -> tuple[float, float] | None:
    """Limits [degC] of a channel whose last scale is that of a thermocouple; None of others."""
    scales = {int(found[1]): value for name, value in properties.items() if (found := SCALE_TYPE.fullmatch(name))}
    last = max(scales, default=0)
    prefix = f"NI_Scale[{last}]_Thermocouple"
    if scales.get(last) != "Thermocouple" or properties.get(f"{prefix}_Scaling_Direction", 0) == 1:
        return None
    low, high = THERMOCOUPLE_LIMITS.get(int(properties.get(f"{prefix}_Thermocouple_Type", 10072)), (-np.inf, np.inf))
    return low - LIMIT_MARGIN, high + LIMIT_MARGIN


def _numbers(properties: Mapping[str, Any]) -> dict[str, float]:
    """The properties that are numbers, or texts that hold one."""
    numbers = {}
    for name, value in properties.items():
        with suppress(ValueError, TypeError):
            numbers[name] = float(value)
    return numbers


def _is_set(time: np.datetime64) -> bool:
    """Whether a start time is one; LabVIEW writes 1904 where there is none."""
    return bool(time > np.datetime64("1904-01-02"))


class _OpenFile:
    """A file that stays open while its channels are used, because its index is long to read."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def _file(self) -> Any:
        from nptdms import TdmsFile

        file = TdmsFile.open(self.path)
        weakref.finalize(self, file.close)
        return file

    def read(self, group: str, name: str, start: int, stop: int) -> Array:
        """Samples start to stop of a channel."""
        with errors_as_damage(self.path, name):
            return as_numbers(self._file[group][name].read_data(start, stop - start))


def _group(opened: _OpenFile, group: str, name: str, facts: dict[str, Any], origin: Any, several: bool) -> ChannelGroup:
    def read(columns: Sequence[int], start: int, stop: int) -> Array:
        values = opened.read(group, name, start, stop)
        if facts["limits"] is not None:
            low, high = facts["limits"]
            values = np.where((values >= low) & (values <= high), values, np.nan)
        return np.repeat(values[:, None], len(columns), axis=1)

    start = facts["offset"]
    if facts["begin"] is not None:
        start += float((facts["begin"] - origin) / np.timedelta64(1, "us")) * 1e-6
    unusable = "" if facts["kind"] in ("i", "u", "f", "b", "M") else "text or complex numbers"
    if facts["samples"] < 2:
        unusable = "without samples"
    facts = {**facts, "unit": "s"} if facts["kind"] == "M" else facts
    raw_scale = f"a scale of type `{facts['unknown_scale']}`" if facts["unknown_scale"] else ""
    channel = ForeignChannel(
        f"{group}/{name}" if several else name,
        facts["unit"],
        scale=raw_scale or facts["scale"],
        is_raw=bool(raw_scale),
    )
    return ChannelGroup((channel,), facts["samples"], read, facts["rate"], start, unusable)
