"""How numbers are written in text files: decimal signs, thousands, missing values."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.io.errors import UserError

Array = NDArray[np.float64]

INFINITIES = ("1.#inf", "-1.#inf")
MISSING_WORDS = (
    *("", "nan", "-nan", "na", "n/a", "#n/a", "null", "none", "-", "--", "---"),
    *("1.#ind", "-1.#ind", "1.#qnan", "-1.#qnan", "1.#snan", *INFINITIES),
)
"""Cells without a value, in lower case. Infinite numbers are none either: the reader of the C library of Microsoft
writes them as `1.#INF`."""
GROUP_SIGNS = (".", ",", "'", "\u2019", "\u00a0", "\u202f", " ")
"""Signs between groups of three digits: point, comma, apostrophes (Switzerland), no-break spaces, space."""
FEWEST_DOUBTFUL = 3
"""Different cells of one column, such as `1.234`, from which they may be whole numbers with a sign for thousands."""
FILLERS = (*(float("9" * digits) for digits in range(3, 8)), 9.9e37, 9.91e37, 3.402823e38, 3.4028235e38)
"""Numbers that loggers write, with either sign, for no value: -9999, SCPI overload, the largest of float32."""
FILLER_RATIO = 20.0
"""Ratio of a filler to the largest of the other values: a reading among others, such as 9999 counts, is one of many."""
LOAD_FILLER_RATIO = 2.0
"""The same for applied loads: they come in steps, and the largest is not twice the next one and all nines besides."""

_ENDS = r"[eEdD][-+]?\d+"
_PLAIN = {
    sign: re.compile(rf"^[-+]?(\d+{mark}?\d*|{mark}\d+)({_ENDS})?$|^[-+]?inf(inity)?$", re.IGNORECASE)
    for sign, mark in ((".", r"\."), (",", ","))
}
_COMPLEX = re.compile(rf"^\(?[-+]?(?:\d+\.?\d*|\.\d+)(?:{_ENDS})? ?[-+] ?(?:\d+\.?\d*|\.\d+)(?:{_ENDS})?[ij]\)?$")
_GROUPED = {
    decimal: re.compile(
        rf"^[-+]?[1-9]\d{{0,2}}(?:(?P<sign>[{''.join(s for s in GROUP_SIGNS if s != decimal)}])\d{{3}})"
        rf"(?:(?P=sign)\d{{3}})*({re.escape(decimal)}\d*)?$"
    )
    for decimal in (".", ",")
}


def is_missing(cell: str) -> bool:
    """Whether a cell stands for no value."""
    return cell.lower() in MISSING_WORDS


def is_complex(cell: str) -> bool:
    """Whether a cell is a complex number as Python and MATLAB write it, `(1.5-2e-3j)` or `1.5 - 0.002i`."""
    return bool(_COMPLEX.match(cell))


def is_number(cell: str, decimal: str) -> bool:
    """Whether a cell is a number with this decimal sign, with or without signs between thousands."""
    return bool(_PLAIN[decimal].match(cell) or _GROUPED[decimal].match(cell))


def is_grouped(cell: str, decimal: str) -> bool:
    """Whether a cell is a number with signs between thousands."""
    return bool(_GROUPED[decimal].match(cell))


def group_sign(cells: Sequence[str], decimal: str) -> str:
    """The sign between thousands in these cells, empty where there is none."""
    return next((match["sign"] for cell in cells if (match := _GROUPED[decimal].match(cell))), "")


def require_clear_decimals(cells: Sequence[str], decimal: str, name: str) -> None:
    """Raise UserError where a column can be fractions, or whole numbers with signs between thousands.

    `1.234` beside `56` and `789` is so; a number with another count of digits on either side of the sign settles it.
    """
    other = "," if decimal == "." else "."
    doubtful = {cell for cell in cells if decimal in cell and is_grouped(cell, other)}
    rest = [cell.lstrip("+-") for cell in cells if cell not in doubtful and not is_missing(cell)]
    are_short = all(cell.isdigit() and len(cell) <= 3 for cell in rest)
    if len(doubtful) >= FEWEST_DOUBTFUL and are_short and any(int(cell) for cell in rest):
        cell = min(doubtful)
        fault = f"`{cell}` can be {cell.replace(decimal, '.')} or {cell.replace(decimal, '')}"
        remedy = "State `decimal` under `text` in the map, or export without signs between thousands"
        raise UserError(fault, place=f"column `{name}`", remedy=remedy)


def without_group_signs(text: bytes, sign: str, decimal: str, separator: str, encoding: str) -> bytes:
    """The text with the signs between thousands taken out of cells that are such numbers as a whole.

    Where the sign is the separator, too, such cells are in quotes.
    """
    encoding = encoding.removesuffix("-sig")  # with it each sign would begin with the mark of the file
    edges = '"' if sign == separator else f'"\r\n {"" if separator == " " else separator}'
    edge = b"[" + re.escape(edges.encode(encoding, "ignore")) + b"]"
    group, point = (re.escape(each.encode(encoding, "ignore")) for each in (sign, decimal))
    begin = b"(?<=" + edge + b")" if sign == separator else b"(?:^|(?<=" + edge + b"))"
    end = b"(?=" + edge + b")" if sign == separator else b"(?=" + edge + b"|$)"
    number = b"[-+]?[1-9]\\d{0,2}(?:" + group + b"\\d{3})+(?:" + point + b"\\d*)?"
    taken_out = sign.encode(encoding, "ignore")
    return re.sub(begin + number + end, lambda match: match[0].replace(taken_out, b""), text)


def without_fortran_exponents(text: bytes) -> bytes:
    """The text with `E` for the exponents of Fortran in double precision, `1.5D+03`."""
    return re.sub(rb"(?<=[\d.,])[dD](?=[-+]?\d)", b"E", text)


def without_blanks(text: bytes, separator: str) -> bytes:
    """The text without blanks beside separators: pandas takes `- ` and ` ` for words."""
    sign = re.escape(separator.encode("latin-1"))
    blanks = rb"(?:^|(?<=[\n" + sign + rb"])) +| +(?=[\r\n" + sign + rb"]|$)"
    return re.sub(blanks, b"", text) if separator != " " else text


def fillers_as_missing(values: Array, ratio: float = FILLER_RATIO) -> Array:
    """Samples (n, k) with NaN for numbers that stand for no value, such as -9999, `ratio` times all other values."""
    if not np.any(np.abs(values) >= FILLERS[0]):
        return values
    for column in values.T:
        sizes = np.abs(column)
        for filler in FILLERS:
            is_filler = sizes == filler
            others = sizes[~is_filler & np.isfinite(sizes)]
            if is_filler.any() and others.max(initial=0.0) * ratio < filler:
                column[is_filler] = np.nan
    return values
