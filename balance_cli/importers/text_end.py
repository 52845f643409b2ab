"""Whether the last number of a text without a final line end was cut off: by a full disk, or a copy that broke off."""

from __future__ import annotations

import re
from collections.abc import Sequence
from enum import Enum

FEWEST_ALIKE = 50
"""Rows that all have as many decimals as each other, from which one with fewer is cut: of numbers without trailing
zeros, nine in ten have all digits, and so many in a row one in 200."""
FEWEST_COMPARED = 5
"""Rows below which nothing is said of the last one."""
_NUMBER = re.compile(r"^[-+]?(?P<whole>\d*)(?:[.,](?P<decimals>\d*))?(?:[ed][-+]?(?P<digits>\d*))?$", re.IGNORECASE)


class Cut(Enum):
    """Whether a number was cut off, as far as those above tell."""

    NO = ""
    MAYBE = "may have broken off within its last number"
    YES = "broke off within its last number"


def cut_number(last: str, above: Sequence[str]) -> Cut:
    """Return whether the last number of a table was cut off, from those above in its column, as they are written."""
    own = _lengths(last)
    others = [lengths for cell in above if (lengths := _lengths(cell)) is not None]
    if own is None or len(others) < FEWEST_COMPARED:
        return Cut.NO
    least = min(others)
    if own >= least:
        return Cut.NO
    return Cut.YES if len(others) >= FEWEST_ALIKE and least == max(others) else Cut.MAYBE


def _lengths(cell: str) -> tuple[int, int] | None:
    """Digits of the exponent and of the decimals, -1 without a mark of either; None where it is no number."""
    match = _NUMBER.match(cell) if cell else None
    if match is None:
        return None
    return _digits(match["digits"]), _digits(match["decimals"])


def _digits(text: str | None) -> int:
    return -1 if text is None else len(text)
