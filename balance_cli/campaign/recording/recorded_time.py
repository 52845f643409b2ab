"""When a run was recorded, as its file states it."""

from __future__ import annotations

from datetime import UTC, datetime


def recorded_time(text: str | None) -> float | None:
    """Return the time [s since 1970] of an attribute `recorded` in ISO 8601, UTC where it states no zone.

    None where it is absent or not to be read.
    """
    try:
        time = datetime.fromisoformat(text or "")
    except ValueError:
        return None
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
