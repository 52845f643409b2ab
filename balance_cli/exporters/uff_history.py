"""Load histories as universal file: datasets 151, 164 and a time response (58) for each component, in text."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS, UNIT_OF
from balance_cli.exporters.uff import (
    DELIMITER,
    EXCITATION_FORCE,
    HUB_NODE,
    UNKNOWN,
    axis_record,
    date_and_time,
    header,
    printable_text,
    units,
)
from balance_cli.io.errors import UserError
from balance_cli.reduction.stored_history import StoredHistory

Array = NDArray[np.float64]

TIME_RESPONSE, REAL_DOUBLE, TIME = 1, 4, 17
"""Codes of dataset 58: the type of the function, that of its ordinate, and the data type of the abscissa."""
VALUES_PER_LINE = 4
LARGEST_UNEVENNESS = 1e-3
"""Steps by which a time may be off even steps: rounding, but no gap."""


def history_uff_text(history: StoredHistory, created: str) -> str:
    """Return a history as text of a universal file, with a function for each component at the hub (node 1).

    Start and step have six digits, as the format has it. Raises UserError where times are not even, or loads missing.
    """
    when, time = datetime.fromisoformat(created), history.time
    step = (time[-1] - time[0]) / (len(time) - 1) if len(time) > 1 else 0.0
    if not step > 0 or np.abs((time - time[0]) / step - np.arange(len(time))).max() > LARGEST_UNEVENNESS:
        fault = f"the times of run {history.run} are not even, or too few"
        raise UserError(fault, "format uff", remedy="Write .csv, .parquet or .mat")
    if not np.isfinite(history.loads).all():
        fault = f"the loads of run {history.run} have gaps, which the format does not know"
        raise UserError(fault, "format uff", remedy="Write .csv, .parquet or .mat")
    lines = [*header(history.run, "hub loads over time", when), *units()]
    for k in range(len(history.components)):
        lines += _function(history, k, step, when)
    return "\n".join(lines) + "\n"


def _function(history: StoredHistory, k: int, step: float, when: datetime) -> Iterator[str]:
    """Yield the lines of one dataset 58: a component of the loads."""
    name = history.components[k]
    direction, is_moment = COMPONENTS.index(name) + 1, int(UNIT_OF[name] != "N")
    yield from (DELIMITER, "    58", name, printable_text(f"run {history.run}"), " ".join(date_and_time(when)))
    yield from ("NONE", "NONE")
    reference = f"{'NONE':<10}{0:10d}{0:4d}"
    yield f"{TIME_RESPONSE:5d}{k + 1:10d}{0:5d}{0:10d} {'hub':<10}{HUB_NODE:10d}{direction:4d} {reference}"
    yield f"{REAL_DOUBLE:10d}{len(history.time):10d}{1:10d}{history.time[0]:13.5E}{step:13.5E}{0.0:13.5E}"
    yield axis_record(TIME, 0, 0, "Time", "s")
    yield axis_record(EXCITATION_FORCE, is_moment, 1, name, UNIT_OF[name])
    yield from [axis_record(UNKNOWN, 0, 0, "NONE", "NONE")] * 2
    values = history.loads[:, k]
    for start in range(0, len(values), VALUES_PER_LINE):
        yield "".join(f"{value:20.12E}" for value in values[start : start + VALUES_PER_LINE])
    yield DELIMITER
