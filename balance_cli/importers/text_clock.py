"""Dates and times of day in text files, as seconds."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from balance_cli.importers.base import Array
from balance_cli.io.errors import UserError

_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_DATE = r"(?P<a>\d{1,4})(?P<mark>[-./])(?P<b>\d{1,2}|[A-Za-z]{3})(?P=mark)(?P<c>\d{1,4})"
CLOCK = re.compile(
    rf"^(?:{_DATE}[ T]?)?(?P<h>\d{{1,2}}):(?P<min>\d{{2}})"
    r"(?::(?P<s>\d{2})(?:(?:[.,]|:(?=\d{3}(?!\d)))(?P<f>\d{1,9}))?)?(?P<half> ?[AP]M)?(?P<zone>Z|[+-]\d\d:?\d\d)?$",
    re.IGNORECASE,
)
"""A time of day, with or without a date before it. Milliseconds may stand behind a colon."""


def seconds_of_clock(texts: Any, place: str) -> Array:
    """Clock times (a pandas Series) as seconds from the midnight before, or from 1970 where they have dates.

    The day comes before the month, but with hours of half days (American), and where the second number is no month.
    Raises UserError, with the first such text, where one is no time or no date.
    """
    parts = texts.str.strip().str.extract(CLOCK)
    bad = parts["h"].isna() & texts.notna()
    if bad.any():
        fault = f"`{texts[bad].iloc[0]}` is no time like those before"
        raise UserError(fault, place=place, remedy="Correct or remove this row")
    hours, minutes = parts["h"].astype(float), parts["min"].astype(float)
    half = parts["half"].str.strip().str.lower()
    hours = hours.where(half.isna(), hours % 12 + 12 * (half == "pm"))
    fraction = ("0." + parts["f"].fillna("0")).astype(float)
    seconds = 3600.0 * hours + 60.0 * minutes + parts["s"].fillna("0").astype(float) + fraction
    if parts["a"].notna().any():
        seconds = seconds + _seconds_of_dates(parts, has_half_days=half.notna().any(), place=place)
    return np.asarray(seconds - _zone_seconds(parts["zone"]), np.float64)


def _zone_seconds(zones: Any) -> Any:
    """Seconds by which the clocks of these zones are ahead of universal time."""
    plain = zones.str.replace(":", "", regex=False).where(zones.str.len() > 1, "+0000").fillna("+0000")
    sign = np.where(plain.str[0] == "-", -1.0, 1.0)
    return sign * (3600.0 * plain.str[1:3].astype(float) + 60.0 * plain.str[3:5].astype(float))


def _seconds_of_dates(parts: Any, has_half_days: bool, place: str) -> Any:
    """Seconds from 1970 to the midnight before; each date of a block is converted once."""
    import pandas as pd

    dates = parts["a"] + "-" + parts["b"] + "-" + parts["c"]
    marks = parts["mark"].dropna()
    month_first = has_half_days or _month_is_first(parts, marks.iloc[0])
    days = {}
    for text in dates.dropna().unique():
        first, second, third = text.split("-")
        if second.lower() in _MONTHS:
            second, month_first = str(_MONTHS.index(second.lower()) + 1), False
        year, month, day = (third, first, second) if month_first else (third, second, first)
        if len(first) == 4:
            year, month, day = first, second, third
        year = f"20{year}" if len(year) == 2 else year
        try:
            days[text] = (pd.Timestamp(int(year), int(month), int(day)) - pd.Timestamp(0)).total_seconds()
        except ValueError as error:
            remedy = "Write dates as 2024-03-31, or export a column of seconds"
            raise UserError(f"`{text}` is no date like those before", place=place, remedy=remedy) from error
    return dates.map(days)


def _month_is_first(parts: Any, mark: str) -> bool:
    """Whether the second number of dates like 3/31/2024 cannot be a month."""
    second = parts["b"].dropna()
    return mark == "/" and bool((second.str.isdigit() & (second.str.pad(2, fillchar="0") > "12")).any())
