"""When a run was recorded, as its file states it."""

from __future__ import annotations

from datetime import UTC, datetime

EARLIEST_DATE, LATEST_DATE = 6.3e8, 2.2e9
"""[s] since 1970. Times from 1990 to 2039 are dates: other clocks begin near zero, or at the year 0 or 1900."""


def recorded_time(text: str | None) -> float | None:
    """Return the time [s since 1970] of an attribute `recorded` in ISO 8601, UTC where it states no zone.

    None where it is absent or not to be read.
    """
    try:
        time = datetime.fromisoformat(text or "")
    except ValueError:
        return None
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()


def unreadable_time(text: str | None) -> str:
    """Return that a stated time is none in ISO 8601, such as one of month 13; empty where it is one, or is absent."""
    if not text or recorded_time(text) is not None:
        return ""
    return f"`recorded` is `{text[:40]}`, which is no time in ISO 8601 such as 2024-03-31T10:11:12: it orders no runs"


def date_of_start(start: float | None) -> str | None:
    """Return the time in ISO 8601 at which a record begins by its column of times [s], None where they are no dates.

    It has no zone, as such columns have none.
    """
    if start is None or not EARLIEST_DATE < start < LATEST_DATE:
        return None
    return datetime.fromtimestamp(start, UTC).replace(tzinfo=None).isoformat("T", "milliseconds")
