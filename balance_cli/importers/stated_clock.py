"""The sample rate that the head of a text file states, itself or by its time step."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from balance_cli.importers.written_numbers import plausible_rate

_GROUPS = r"\d{1,3}(?:[ '\u00a0\u202f]\d{3})+|\d+"
_POWER = r"(?:e(?P<power>[-+]?\d+))?+"
_NUMBER = rf"(?P<number>(?:{_GROUPS})(?:[.,]\d+)*|[.,]\d+){_POWER}(?!\d|[.:]\d)"
_POINT_NUMBER = rf"(?P<number>(?:{_GROUPS})(?:\.\d+)*|\.\d+){_POWER}(?!\d|[.:]\d)"
"""The same where the comma stands between cells."""
_RATE_UNIT = r"(?P<{0}>[km]?)(?:hz|sps|s/s|sa/s|samples?(?:/| per )s(?:ec(?:onds?)?)?)\b"
_TIME_UNIT = r"(?P<{0}>[mun\u00b5\u03bc]?)(?:s|sec|seconds?)\b"
_SIGNS = r"[ \t\"'=:;,_()\[\]|-]*"
"""Between a word and its number are only signs and a unit: `default sample rate <tab> DMS_1` states none."""
_RATES = (
    re.compile(
        r"(?:\b(?:sampl\w*?|scan(?:ning)?|acquisition|daq|data)[ _-]*(?:rate|freq(?:uency)?)"
        r"|^\W*update[ _]rate|abtast(?:rate|frequenz)|サンプリング周波数|采样(?:频率|率)"
        r"|^no_of_\w+[\t :=,;]+\d+\s*\nfrequency"
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
    rf"|abtastintervall|interval(?=[ \t]*[=:])|測定間隔)\b{_SIGNS}(?:{_TIME_UNIT.format('before')})?{_SIGNS}{_NUMBER}"
    rf"[ \t,;]*+(?:{_TIME_UNIT.format('behind')}|(?![a-z%]))",
    re.IGNORECASE | re.MULTILINE,
)
"""A time step, as LabVIEW (`Delta_X`), catman (`DT = `), imc (`dx:`) and seismology (`DELTA: `) state it."""
_BETWEEN = r"(?:,(?= )|[ \t\";|])*"
_CELL = {False: _BETWEEN + _NUMBER, True: _BETWEEN.replace("]", ",]") + _POINT_NUMBER}
_MORE_RATES, _MORE_STEPS = (
    {key: re.compile(rf"{cell}(?:[ \t,;\"]*{unit.format('behind')})?", re.IGNORECASE) for key, cell in _CELL.items()}
    for unit in (_RATE_UNIT, _TIME_UNIT)
)
"""A number with its unit in a row of them, by whether the comma stands between cells."""
_ENDS = re.compile(r"[ \t\"]*(?:$|[,;|\t])")
_RATE_POWERS = {"": 0, "k": 3, "m": 6}
_TIME_POWERS = {"": 0, "m": -3, "u": -6, "\u00b5": -6, "\u03bc": -6, "n": -9}


def stated_rates(head: Sequence[str], separator: str = "") -> tuple[float, ...]:
    """Return the sample rates [Hz] that the lines of a head state for one channel or several, each once.

    Empty where there is none, or the number is ambiguous: `1,024` may be 1024 or 1.024. With the comma as `separator`
    of the file its numbers have no decimal comma, and `1000,500` are two rates.
    """
    text = "\n".join(head)
    for pattern in _RATES:
        if match := pattern.search(text):
            numbers = _written_numbers(match, separator, _MORE_RATES, _RATE_POWERS)
            return _distinct(rate for number in numbers if (rate := _rate(number)) is not None)
    step = _STEP.search(text)
    numbers = _written_numbers(step, separator, _MORE_STEPS, _TIME_POWERS) if step else []
    return _distinct(rate for number in numbers if (rate := _rate_of_step(number)) is not None)


def _distinct(rates: Iterable[float]) -> tuple[float, ...]:
    return tuple(dict.fromkeys(rates))


def _rate(number: str) -> float | None:
    rate = float(number)
    return rate if 0.0 < rate < float("inf") else None


def _rate_of_step(number: str) -> float | None:
    try:
        return plausible_rate(number)[0]
    except ValueError:
        return None


def _written_numbers(
    match: re.Match[str], separator: str, patterns: dict[bool, re.Pattern[str]], powers: dict[str, int]
) -> list[str]:
    """Return the numbers behind the word of a match, in the unit without prefix, as Python writes them.

    Empty where one is ambiguous. What follows the first number is one of them if nothing but a unit stands behind it.
    """
    line = match.string[match.start("number") :].partition("\n")[0]
    found: list[re.Match[str]] = []
    position, pattern = 0, patterns[separator == ","]
    while (item := pattern.match(line, position)) and (not found or _ENDS.match(line, item.end())):
        if found and found[-1]["behind"] is not None and item["behind"] is None:
            break  # behind a number with its unit stands another quantity: `1000 Hz, 16`
        found.append(item)
        position = item.end()
    numbers = [_without_signs(item["number"]) for item in found]
    if not numbers or any(number is None for number in numbers):
        return []
    common = match["before"] or found[-1]["behind"] or ""
    return [
        f"{number}e{int(item['power'] or 0) + powers[(match['before'] or item['behind'] or common).lower()]}"
        for item, number in zip(found, numbers, strict=True)
    ]


def _without_signs(written: str) -> str | None:
    """Return a number without signs between thousands and with a decimal point; None where it is ambiguous."""
    digits = re.sub(r"[ '\u00a0\u202f]", "", written)
    cells = set(digits.split(","))
    # The same for each of several channels; else a comma is that of a decimal number or of thousands.
    number = cells.pop() if len(cells) == 1 else _without_comma(digits)
    return None if number is None or number.count(".") > 1 else number


def _without_comma(digits: str) -> str | None:
    whole, *groups = digits.split(",")
    if len(groups) > 1 or "." in digits or (whole.strip("0") and len(whole) <= 3 and len(groups[0]) == 3):
        return None
    return f"{whole}.{groups[0]}"
