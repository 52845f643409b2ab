"""Numbers as text, with as many digits as are significant."""

from __future__ import annotations

import math

MINUS = "\N{MINUS SIGN}"
MISSING_VALUE = "\N{EN DASH}"
MAX_DIGITS = 8
"""Digits of a value whose sigma is very small: more would not fit a table, and no input has more."""
MARKED_SIGMA = 3.0
"""Standard errors beyond which a number is marked (p = 0.0027)."""
SMALLEST_PLAIN, LARGEST_PLAIN = 1e-3, 1e5
"""Range of numbers that are written without an exponent."""


def format_significant(value: float, digits: int = 3) -> str:
    """A number to `digits` significant digits, without an exponent where it is short enough."""
    if not math.isfinite(value):
        return MISSING_VALUE
    if value == 0:
        return "0"
    rounded = float(f"{value:.{digits - 1}e}")
    exponent = math.floor(math.log10(abs(rounded)))
    if -4 <= exponent < max(digits, 5):
        return f"{rounded:.{max(digits - 1 - exponent, 0)}f}".replace("-", MINUS)
    return f"{rounded:.{digits - 1}e}".replace("e+0", "e").replace("e-0", "e-").replace("e+", "e").replace("-", MINUS)


def format_percent(ratio: float) -> str:
    """A ratio in percent, without the percent sign; `<0.001` below a thousandth of a percent."""
    if not math.isfinite(ratio):
        return MISSING_VALUE
    value = 100.0 * ratio
    if 0 < abs(value) < 1e-3:
        return "<0.001"
    return format_significant(value, 3 if abs(value) >= 100 else 2)


def value_and_sigma_text(value: float, sigma: float) -> tuple[str, str]:
    """Value and sigma to the second significant digit of sigma, at most MAX_DIGITS of value; exact values to six."""
    if not (math.isfinite(sigma) and sigma > 0):
        return (f"{value:.6g}".replace("-", MINUS) if math.isfinite(value) else MISSING_VALUE), MISSING_VALUE
    if not math.isfinite(value):
        return MISSING_VALUE, format_significant(sigma, 2)
    decimals = 1 - math.floor(math.log10(float(f"{sigma:.1e}")))
    size = max(abs(value), sigma)
    exponent = math.floor(math.log10(size))
    digits = max(exponent + 1 + decimals, 2)
    if size >= LARGEST_PLAIN and digits <= MAX_DIGITS:
        parts = (f"{part / 10**exponent:.{max(digits - 1, 0)}f}e{exponent}" for part in (value, sigma))
        return (next(parts).replace("-", MINUS), next(parts))
    if digits > MAX_DIGITS or size < SMALLEST_PLAIN or size >= LARGEST_PLAIN:
        return format_significant(value, min(digits, MAX_DIGITS)), format_significant(sigma, 2)
    return format_fixed(value, max(decimals, 0)), format_fixed(sigma, max(decimals, 0))


def format_fixed(value: float, decimals: int) -> str:
    """A number with a fixed number of decimals."""
    if not math.isfinite(value):
        return MISSING_VALUE
    text = f"{value:.{decimals}f}"
    return text.lstrip("-") if float(text) == 0 else text.replace("-", MINUS)


def capitalize_first(text: str) -> str:
    """The text with its first letter capitalized."""
    return text[:1].upper() + text[1:]


def join_names(names: tuple[str, ...] | list[str]) -> str:
    """Names as in a sentence: `a, b and c`."""
    if len(names) < 2:
        return "".join(names)
    return f"{', '.join(names[:-1])} and {names[-1]}"
