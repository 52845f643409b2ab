"""Ratios in percent as text."""

from __future__ import annotations

from collections.abc import Mapping


def percent_text(ratio: float, digits: int = 2) -> str:
    """Return a ratio in percent with the given number of significant digits, without an exponent below a million.

    >>> percent_text(1.12), percent_text(0.01234), percent_text(13.02, 3)
    ('110', '1.2', '1300')
    """
    return f"{float(f'{100 * ratio:.{digits}g}'):.6g}"


def named_percents(ratios: Mapping[str, float]) -> str:
    """Return ratios in percent with their names, three significant digits each.

    >>> named_percents({"Fx": 0.1201, "My": 0.2614})
    'Fx by 12 %, My by 26.1 %'
    """
    return ", ".join(f"{name} by {percent_text(ratio, 3)} %" for name, ratio in ratios.items())
