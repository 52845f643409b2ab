"""Heads of columns: the name of a quantity and its unit. Imports nothing heavy."""

from __future__ import annotations

import re

from balance_cli.io.units import is_unit

_HEADERS = (
    re.compile(r"^(?P<name>.*?)\s*\[(?P<unit>[^\[\]]*)\]\s*$"),
    re.compile(r"^(?P<name>.*?)\s*\((?P<unit>.*)\)\s*$"),
)
"""`Fx [N]` and `Fx (N)`; the second is greedy because units can have brackets themselves."""
_HEADER_OF_RUN = re.compile(
    r"^(?P<name>.+?)\s*[(\[](?P<unit>[^()\[\]]+)[)\]]\s+(?P<run>Run\s*#?\s*\d+)$", re.IGNORECASE
)
"""`Force (N) Run #1`, as data loggers of several runs write."""


def split_quotient(header: str) -> tuple[str, str | None]:
    """Split the head of a column as `split_unit`, or as ISO 80000-1 writes it, the quantity over its unit: `Fx/N`.

    What is a unit as a whole (`mV/V`) and what has no name before the sign (`1/rev`) has none.
    """
    name, unit = split_unit(header)
    if unit is not None or is_unit(name):
        return name, unit
    for sign in re.finditer("/", name):
        before, behind = name[: sign.start()].strip(), name[sign.end() :].strip()
        if before[:1].isalpha() and is_unit(behind) and not behind[0].isdigit():
            return before, behind
    return name, None


def split_unit(header: str) -> tuple[str, str | None]:
    """Split the head of a column into name and unit: `Fx [N]`, `Fx (N)`; the unit is None where there is none.

    What follows a unit may be a run: `Fx (N) Run #1` is `Fx Run #1`.
    """
    of_run = _HEADER_OF_RUN.match(header.strip())
    if of_run and is_unit(of_run["unit"]):
        return f"{of_run['name']} {of_run['run']}", of_run["unit"].strip()
    for pattern in _HEADERS:
        match = pattern.match(header.strip())
        if match and match["name"]:
            return match["name"].strip(), match["unit"].strip()
    return header.strip(), None
