"""The sample rate that the head of a text file states, itself or by its time step."""

from __future__ import annotations

import re
from collections.abc import Sequence

from balance_cli.importers.written_numbers import plausible_rate

_NUMBER = r"(?P<number>\d+(?:[ '\u00a0\u202f]\d{3})*(?:[.,]\d+)*|[.,]\d+)(?:e(?P<power>[-+]?\d+))?(?!\d|[.,:]\d)"
_RATE_UNIT = r"(?P<{0}>[km]?)(?:hz|sps|s/s|sa/s|samples?(?:/| per )s(?:ec(?:onds?)?)?)\b"
_TIME_UNIT = r"(?P<{0}>[mun\u00b5\u03bc]?)(?:s|sec|seconds?)\b"
_SIGNS = r"[ \t\"'=:;,_()\[\]|-]*"
"""Between a word and its number are only signs and a unit: `default sample rate <tab> DMS_1` states none."""
_RATES = (
    re.compile(
        r"(?:\b(?:sampl\w*?|scan(?:ning)?|acquisition|daq|data)[ _-]*(?:rate|freq(?:uency)?)|abtast(?:rate|frequenz)"
        rf"|messrate|\bf_?s|^\W*rate){_SIGNS}(?:{_RATE_UNIT.format('before')})?{_SIGNS}{_NUMBER}"
        rf"[ \t,;]*(?:{_RATE_UNIT.format('behind')})?",
        re.IGNORECASE | re.MULTILINE,
    ),
    re.compile(rf"\b{_RATE_UNIT.format('before')}{_SIGNS}{_NUMBER}(?P<behind>)[ \t]*$", re.IGNORECASE | re.MULTILINE),
    re.compile(rf"(?<![\w.,]){_NUMBER}[ \t]*(?P<before>)(?P<behind>[km]?)(?:sps|s/s|sa/s)\b", re.IGNORECASE),
)
"""A word for the rate and its number; a unit of rates and its number; and the reverse (`100 sps`, `2 kS/s`)."""
_STEP = re.compile(
    r"^\W*(?:delta(?:[ _]?[xt])?|d[tx]|x-axis delta|time[ _](?:step|interval)|sampl\w*[ _](?:interval|period|time)"
    rf"|abtastintervall)\b{_SIGNS}(?:{_TIME_UNIT.format('before')})?{_SIGNS}{_NUMBER}"
    rf"[ \t,;]*+(?:{_TIME_UNIT.format('behind')}|(?![a-z%]))",
    re.IGNORECASE | re.MULTILINE,
)
"""A time step, as LabVIEW (`Delta_X`), catman (`DT = `), imc (`dx:`) and seismology (`DELTA: `) state it."""
_RATE_POWERS = {"": 0, "k": 3, "m": 6}
_TIME_POWERS = {"": 0, "m": -3, "u": -6, "\u00b5": -6, "\u03bc": -6, "n": -9}


def stated_rate(head: Sequence[str]) -> float | None:
    """Return the sample rate [Hz] that the lines of a head state; None where there is none, or its number is ambiguous.

    `1,024` may be 1024 or 1.024: then nothing is stated.
    """
    text = "\n".join(head)
    for pattern in _RATES:
        if match := pattern.search(text):
            return _rate(_written_number(match, _RATE_POWERS))
    step = _STEP.search(text)
    number = _written_number(step, _TIME_POWERS) if step else None
    try:
        return plausible_rate(number)[0] if number else None
    except ValueError:
        return None


def _rate(number: str | None) -> float | None:
    rate = float(number) if number else 0.0
    return rate if 0.0 < rate < float("inf") else None


def _written_number(match: re.Match[str], powers: dict[str, int]) -> str | None:
    """Return the number of a match in the unit without prefix, as Python writes it; None where it is ambiguous."""
    digits = re.sub(r"[ '\u00a0\u202f]", "", match["number"])
    cells = set(digits.split(","))
    # The same step for each of several channels; else a comma is that of a decimal number or of thousands.
    number = cells.pop() if len(cells) == 1 else _without_comma(digits)
    if number is None or number.count(".") > 1:
        return None
    prefix = (match["before"] or match["behind"] or "").lower()
    return f"{number}e{int(match['power'] or 0) + powers[prefix]}"


def _without_comma(digits: str) -> str | None:
    whole, *groups = digits.split(",")
    if len(groups) > 1 or "." in digits or (whole.strip("0") and len(whole) <= 3 and len(groups[0]) == 3):
        return None
    return f"{whole}.{groups[0]}"
