"""How a text file of columns is laid out: encoding, separator, decimal sign, rows of names and units, first row."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass

from balance_cli.importers.base import TextLayout
from balance_cli.io.errors import UserError
from balance_cli.io.units import parse_unit, split_unit

SEPARATORS = ("\t", ";", ",", "|", " ")
"""Candidates; the space stands for any run of spaces."""
MISSING_WORDS = ("", "nan", "na", "n/a", "#n/a", "null", "none", "-", "--", "---", "1.#ind", "-1.#ind", "1.#qnan")
"""Cells without a value, in lower case."""
NUMERIC_SHARE = 0.5
"""Share of the cells of a row that must be numbers, times or empty for a row of data; a row of names has hardly any."""
TYPICAL_ROWS = 50
"""Rows whose usual number of cells is that of the table."""
UNIT_SHARE = 0.5
"""Share of the cells of a row that must be units for a row of units; names such as `N` or `Mz` are rare."""

_NUMBER = {
    ".": re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)([eEdD][-+]?\d+)?$|^[-+]?inf(inity)?$", re.IGNORECASE),
    ",": re.compile(r"^[-+]?(\d+,?\d*|,\d+)([eEdD][-+]?\d+)?$|^[-+]?inf(inity)?$", re.IGNORECASE),
}
_CLOCK = re.compile(r"^(\d{1,4}[-./]\d{1,2}[-./]\d{1,4}[ T]?)?\d{1,2}:\d{2}(:\d{2}([.,]\d+)?)?(Z|[+-]\d\d:?\d\d)?$")
_RATE = re.compile(
    r"(?:sampl\w*[ _-]*(?:rate|freq\w*)|abtastrate|messrate|\bfs)\b[^0-9\n]*?([0-9]+(?:[.,][0-9]+)?)\s*(k?hz)?",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Columns:
    """The layout that was found.

    `first_row` counts from 0. `numeric` are the columns of numbers, `clock` those of dates or times of day; others are
    text, or empty without a name.
    """

    encoding: str
    separator: str
    decimal: str
    first_row: int
    names: tuple[str, ...]
    units: tuple[str, ...]
    numeric: tuple[int, ...]
    clock: tuple[int, ...]
    stated_rate: float | None = None


def find_encoding(head: bytes) -> str:
    """Encoding by byte order mark, by zero bytes of UTF-16, else UTF-8 where valid, else Windows-1252."""
    if head.startswith(b"\xef\xbb\xbf"):
        return "utf-8-sig"
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    if len(head) > 3 and head[1:64:2].count(0) > 0.8 * len(head[1:64:2]):
        return "utf-16-le"
    if len(head) > 3 and head[0:64:2].count(0) > 0.8 * len(head[0:64:2]):
        return "utf-16-be"
    try:
        head[: len(head) - 4].decode("utf-8")  # the last character may be cut
        return "utf-8"
    except UnicodeDecodeError as error:
        return "utf-8" if error.start > len(head) - 8 else "cp1252"


def find_columns(text: str, is_whole: bool, encoding: str, layout: TextLayout) -> Columns:
    """Find the layout from the beginning of a file; what `layout` states is taken as given.

    Raises UserError where no columns of numbers are found.
    """
    lines = text.splitlines() if is_whole else text.splitlines()[:-1]
    stated = re.match(r"^sep=(.)$", lines[0]) if lines else None
    separators = [layout.separator or stated[1]] if layout.separator or stated else list(SEPARATORS)  # type: ignore[index]
    decimals = [layout.decimal] if layout.decimal else [".", ","]
    choices = [
        _lay_out(lines, separator, decimal, layout)
        for separator in separators
        for decimal in decimals
        if separator != decimal
    ]
    best = max((choice for choice in choices if choice), key=lambda choice: choice[0], default=None)
    if best is None:
        raise UserError("has no columns of numbers", remedy="State `separator`, `decimal` and `first_row` under `text`")
    _, separator, decimal, first = best
    rows = [split_cells(line, separator) for line in lines]
    names, units = _names_and_units(rows[:first], rows[first:], layout)
    numeric, clock = _column_kinds(rows[first:], decimal, names)
    rate = _stated_rate(lines[:first])
    return Columns(encoding, separator, decimal, first, names, units, numeric, clock, rate)


def split_cells(line: str, separator: str) -> list[str]:
    """The cells of a row, without quotes and outer spaces."""
    if separator == " ":
        return line.replace('"', "").split()
    if '"' in line:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]
    return [cell.strip() for cell in line.split(separator)]


Score = tuple[int, int, float, int, int]


def _lay_out(
    lines: Sequence[str], separator: str, decimal: str, layout: TextLayout
) -> tuple[Score, str, str, int] | None:
    """Score, separator, decimal sign and first row of data of one choice; None where it has no rows of numbers."""
    rows = [split_cells(line, separator) for line in lines]
    filled = [k for k, row in enumerate(rows) if any(row)]
    if not filled:
        return None
    lengths = [len(rows[k]) for k in filled[-TYPICAL_ROWS:]]
    width = max(set(lengths), key=lambda length: (lengths.count(length), length))
    if layout.first_row is not None:
        first = layout.first_row - 1
    else:
        first = filled[-1] + 1
        ends = filled[:-1] if len(filled) > 1 and len(rows[filled[-1]]) < width else filled  # the last one may be cut
        for k in reversed(ends):
            if len(rows[k]) != width or not _is_data(rows[k], decimal):
                break
            first = k
    count = sum(1 for k in filled if k >= first)
    numeric, clock = _column_kinds(rows[first:], decimal, ("",) * width)
    if not count or not numeric:
        return None
    used = sum(any(len(row) > column and row[column] for row in rows[first:]) for column in range(width))
    share = (len(numeric) + len(clock)) / used
    header = next((rows[k] for k in reversed(filled) if k < first), None)
    matches = header is None or len(header) == width
    # Integers are numbers with either decimal sign, and the point is then the usual one.
    return (count, int(matches), share, width, int(decimal == ".")), separator, decimal, first


def _is_data(row: Sequence[str], decimal: str) -> bool:
    values = [cell for cell in row if cell.lower() not in MISSING_WORDS]
    numbers = sum(bool(_NUMBER[decimal].match(cell)) for cell in values)
    clocks = sum(bool(_CLOCK.match(cell)) for cell in values)
    return numbers > 0 and numbers + clocks >= NUMERIC_SHARE * len(values)


def _column_kinds(
    rows: Sequence[Sequence[str]], decimal: str, names: Sequence[str]
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Columns of numbers, and of clock times; one without values and name is neither."""
    numeric, clock = [], []
    for column, name in enumerate(names):
        cells = [row[column] for row in rows if len(row) > column and row[column].lower() not in MISSING_WORDS]
        if all(_NUMBER[decimal].match(cell) for cell in cells) and (cells or name):
            numeric.append(column)
        elif cells and all(_CLOCK.match(cell) for cell in cells):
            clock.append(column)
    return tuple(numeric), tuple(clock)


def _names_and_units(
    header: Sequence[Sequence[str]], data: Sequence[Sequence[str]], layout: TextLayout
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of the columns from the rows above the data, `column 1` and so on where there are none."""
    width = len(data[0])
    candidates = [k for k, row in enumerate(header) if any(row) and abs(len(row) - width) <= 1]
    unit_row = layout.unit_row - 1 if layout.unit_row else None
    if unit_row is None and layout.name_row is None and len(candidates) > 1 and _are_units(header[candidates[-1]]):
        unit_row = candidates[-1]
    rest = [k for k in candidates if k != unit_row]
    name_row = layout.name_row - 1 if layout.name_row else (rest[-1] if rest else None)
    names = _padded(header, name_row, width)
    units = _padded(header, unit_row, width)
    pairs = [split_unit(name.lstrip("#").strip()) for name in names]
    has_names = any(names)
    plain = tuple(name if has_names else f"column {k + 1}" for k, (name, _) in enumerate(pairs))
    from_names = [unit or "" for _, unit in pairs]
    return plain, tuple(_strip_unit(unit) or own for unit, own in zip(units, from_names, strict=True))


def _padded(rows: Sequence[Sequence[str]], row: int | None, width: int) -> list[str]:
    if row is None or not 0 <= row < len(rows):
        return [""] * width
    cells = list(rows[row])[:width]
    return cells + [""] * (width - len(cells))


def _strip_unit(text: str) -> str:
    return text.strip().strip("[]()").strip()


def _are_units(row: Sequence[str]) -> bool:
    cells = [_strip_unit(cell.lstrip("#")) for cell in row if cell]
    return bool(cells) and sum(_is_unit(cell) for cell in cells) > UNIT_SHARE * len(cells)


def _is_unit(text: str) -> bool:
    try:
        parse_unit(text)
    except UserError as error:
        return "can be" in error.fault  # a unit with two meanings
    return True


def _stated_rate(header: Sequence[str]) -> float | None:
    """A sample rate [Hz] that the header states, for a sketch."""
    match = _RATE.search("\n".join(header))
    if not match:
        return None
    return float(match[1].replace(",", ".")) * (1000.0 if (match[2] or "").lower() == "khz" else 1.0)
