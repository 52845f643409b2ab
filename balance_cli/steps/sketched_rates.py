"""Sample rate or times of the files of other programs, for the sketch of a map."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator

from balance_cli.campaign.recording.import_map_file import UNFINISHED
from balance_cli.importers.base import ForeignChannel, ForeignFile
from balance_cli.io.errors import UserError
from balance_cli.steps.sketched_times import time_axis
from balance_cli.steps.stated_rates import RATE_TOLERANCE, stated_rate, stated_rates, time_unit

FASTEST_GUESS = 2e6
"""[Hz]. Times without a unit that would be of a higher rate are hardly seconds: dates of spreadsheets count days."""
UNIT_IN_NAME = re.compile(r"(?:[a-z]_|^)(s|ms|us|ns|milli(?=s$)|micro(?=s$))s?$", re.IGNORECASE)
"""As counters are named: `ts_ms`, `time_us`, and `millis` or `micros` by microcontrollers."""
UNIT_WORDS = {"milli": "ms", "micro": "us"}
EPOCH = (1e9, 1e10)
"""[s] from 1970, of the years 2001 to 2286: a first time is in this range in one unit only."""
EPOCH_UNITS = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}
YAML_WORDS = {"yes", "no", "on", "off", "true", "false", "null", "y", "n"}
"""Words that YAML does not take for text."""


def quoted(text: str) -> str:
    """Return a text as a YAML scalar: plain where that is safe, else in quotes."""
    if text.lower() in YAML_WORDS:
        return json.dumps(text)
    return text if re.fullmatch(r"[A-Za-z][\w./+-]*( [\w./+-]+)*", text) else json.dumps(text, ensure_ascii=False)


def rate_lines(file: ForeignFile, time: ForeignChannel | None) -> Iterator[str]:
    """Yield the lines of a map that state the sample rate, or the times that tell it."""
    rates = sorted({group.rate for group in file.groups if group.rate is not None and not group.unusable})
    if rates:
        yield f"# sampled at {', '.join(f'{rate:.10g} Hz' for rate in rates)}"
        return
    own = [group for group in file.groups if group.time is not None]
    for group in own:
        names = ", ".join(name for name in group.names if name != group.names[group.time or 0])
        yield f"# `{group.names[group.time or 0]}` is the time of {names}"
    if time is not None:
        yield f"time: {quoted(time.name)}" + ("  # and the others as above" if own else "")
        yield from _unit_lines(file, time)
        return
    stated = [f"{rate:.10g}" for rate in stated_rates(file)]
    if len(stated) == 1:
        yield f"sample_rate: {stated[0]}  # Hz, as the file says"
    else:
        yield "sample_rate: TODO  # Hz" + (f": the file says {' and '.join(stated)}" if stated else "")


def _unit_lines(file: ForeignFile, time: ForeignChannel) -> Iterator[str]:
    """The unit of the times, to be completed where the file states none and their steps are not those of seconds."""
    group = next(group for group in file.groups if any(channel is time for channel in group.channels))
    axis = time_axis(group, next(k for k, channel in enumerate(group.channels) if channel is time))
    stated, named = stated_rate(file), "" if time.unit else _unit_in_name(time)
    factor = _factor(time.unit or named)
    rate = None if axis is None else axis.rate / (factor or 1.0)
    agrees = rate is not None and stated is not None and abs(rate / stated - 1.0) < RATE_TOLERANCE
    if named:
        yield f"time_unit: {named}  # as its name says"
    elif factor is None and agrees:
        yield "time_unit: s  # the head states the same rate"
    elif factor is None and axis is not None and (unit := _unit_since_1970(axis.start)):
        yield f"time_unit: {unit}  # counted from 1970, which no other unit makes likely"
    elif factor is None and (rate is None or 1.0 < rate < FASTEST_GUESS):
        yield "time_unit: s  # assumed: the file states no unit of its times"
    elif factor is None:
        yield f"time_unit: {UNFINISHED}  # s, ms, us, ns, min, h or d (dates of spreadsheets): the file states none"
        yield f"# in one of them are {rate:.6g} samples"
        yield "# sample_rate: TODO  # Hz, in place of time and time_unit, where it is none of these"
    if rate is not None and stated is not None and not agrees:
        yield f"# TODO: the head states {stated:.10g} Hz, these times are of {rate:.10g} Hz"


def _unit_in_name(time: ForeignChannel) -> str:
    """The unit of time at the end of a name such as `ts_ms`, empty where there is none."""
    match = UNIT_IN_NAME.search(time.name)
    word = match[1].lower() if match else ""
    return UNIT_WORDS.get(word, word)


def _unit_since_1970(start: float) -> str:
    """The unit in which a first time is one of our days; empty where it is none."""
    return next((unit for unit, factor in EPOCH_UNITS.items() if EPOCH[0] <= start * factor < EPOCH[1]), "")


def _factor(unit: str) -> float | None:
    """Seconds of a unit of time, None where a text names none."""
    try:
        return time_unit(unit).factor if unit else None
    except UserError:
        return None
