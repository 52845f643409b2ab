"""Names and units of the columns of a text file, from the rows above the data."""

from __future__ import annotations

import re
from collections.abc import Sequence

from balance_cli.importers.base import TextLayout
from balance_cli.importers.text_clock import CLOCK
from balance_cli.importers.unit_rows import UNIT_KEYS, are_units, are_units_of, says_units
from balance_cli.io.column_heads import split_quotient
from balance_cli.io.errors import UserError
from balance_cli.io.text_format import REMARKS
from balance_cli.io.text_numbers import is_number

KEY = re.compile(r"^[A-Za-z][\w -]*[:=]$")
"""The first cell of a row of a head that says what the others are, as imc (`Name:`, `Unit:`, `dx:`) and LabChart
(`ChannelTitle=`) write it."""
KEY_ENDS = ":="
NAME_KEYS = (
    *("name", "names", "channel name", "channel names", "channel", "kanalname", "kanal", "signal", "tracename"),
    *("channeltitle", "ch名称", "ch no"),
)
"""The last two are those of Japanese loggers, the more telling first."""
NO_UNIT = ("*", "/")
"""Signs in a row of units above columns that have none."""
REMARK_SIGNS = (*REMARKS, ";", "!")
"""Signs before the names of a head of remarks."""

Rows = Sequence[Sequence[str]]


def names_and_units(header: Rows, data: Rows, layout: TextLayout) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of the columns from the rows above the data, `column 1` and so on where there are none.

    Raises UserError where names and columns differ in number, so that nothing says which is whose.
    """
    width = len(data[0])
    rows = [_fitting(_without_remark_sign(row, width), data, width) for row in header]
    candidates = [k for k, row in enumerate(rows) if any(row) and abs(len(row) - width) <= 1]
    keys = _keys(rows, candidates, data)
    name_row = next((keys[key] for key in NAME_KEYS if key in keys), None)
    plain = [k for k in candidates if k not in keys.values()]
    if name_row is not None and layout.name_row is None and not _stand_below(rows, plain, name_row, data):
        return _keyed_names(rows, keys, name_row, data)
    unit_row = layout.unit_row - 1 if layout.unit_row else None
    if unit_row is None and layout.name_row is None and len(plain) > 1:
        unit_row = _find_units(rows, plain, data)
    rest = [k for k in plain or candidates if k != unit_row and (plain or len(rows[k]) == width)]
    is_keyed = unit_row is not None and says_units(rows[unit_row])
    # Names stand above a row of units, but below the keyed rows of LabVIEW.
    name_row = layout.name_row - 1 if layout.name_row else _best_names(rows, rest, None if is_keyed else unit_row)
    shift = 0 if layout.name_row or name_row is None else _shift(rows[name_row], data, width)
    names = _padded(rows, name_row, width, shift)
    above = [_padded(rows, k, width, shift) for k in reversed(rest) if name_row is not None and k < name_row]
    if not layout.name_row:
        names = _completed(names, above)
    units = _padded(rows, unit_row, width, shift if unit_row is not None and len(rows[unit_row]) < width else 0)
    units = ["", *units[1:]] if is_keyed else units
    pairs = [split_quotient(name.lstrip("#").strip()) for name in names]
    if not layout.name_row:
        pairs = _distinguished(pairs, above)
    # The time that a monitor writes before the line of names is no name.
    shown = tuple(
        name if any(names) and not CLOCK.match(name) else f"column {k + 1}" for k, (name, _) in enumerate(pairs)
    )
    from_names = [unit or "" for _, unit in pairs]
    return shown, tuple(_strip_unit(unit) or own for unit, own in zip(units, from_names, strict=True))


def _without_remark_sign(row: Sequence[str], width: int) -> Sequence[str]:
    """The row of a head without the sign of a remark, in a cell of its own or before the first name."""
    if not row or not row[0].startswith(REMARK_SIGNS):
        return row
    first = row[0].lstrip("#%;!/").strip()
    return [first, *row[1:]] if first or len(row) <= width else row[1:]


def _fitting(row: Sequence[str], data: Rows, width: int) -> Sequence[str]:
    """The row of a head without the names of columns at the end that have no cells, as test stands write them.

    Rows of data that end with empty cells, and in fewer of them than the head, leave out what has no value.
    """
    has_empty_end = all(not cells[-1] for cells in data if len(cells) == width)
    return row[:width] if len(row) > width + 1 and has_empty_end and all(row[:width]) else row


def names_without_cells(header: Rows, data: Rows) -> tuple[str, ...]:
    """The names at the end of a head for which the rows of data have no cells."""
    width = len(data[0])
    rows = [row for row in header if _fitting(row, data, width) is not row]
    return tuple(name for row in rows[-1:] for name in row[width:] if name)


def _find_units(rows: Rows, plain: Sequence[int], data: Rows) -> int | None:
    """The row of units: the last one of them, else the last row where it has units of the names directly above it."""
    unit_row = next((k for k in reversed(plain) if are_units(rows[k])), None)
    if unit_row is None and are_units_of(rows[plain[-1]], rows[plain[-2]], data):
        return plain[-1]
    return unit_row


def _stand_below(rows: Rows, plain: Sequence[int], name_row: int, data: Rows) -> bool:
    """Whether names and a row of units without keys stand below a row that begins with a key of names."""
    below = [k for k in plain if k > name_row]
    return len(below) > 1 and _find_units(rows, below, data) is not None


def _keys(rows: Rows, candidates: Sequence[int], data: Rows) -> dict[str, int]:
    """Rows that begin with a word on what the others are: with a colon, or above a column that has no data.

    Above a column of numbers they need no colon where one begins with a word for names and others with one for units
    or with settings that are numbers.
    """
    is_empty = not any(row[0] for row in data if row)
    begins = {k: rows[k][0].rstrip(KEY_ENDS).lower() for k in candidates if rows[k][0]}
    keyed = [k for k in begins if KEY.match(rows[k][0]) or is_empty]
    if is_empty and not any(begins[k] in NAME_KEYS for k in keyed):
        keyed = [k for k in keyed if KEY.match(rows[k][0])]
    bare = [k for k, begin in begins.items() if begin in (*NAME_KEYS, *UNIT_KEYS) or _has_settings(rows[k])]
    has_names = any(begins[k] in NAME_KEYS for k in keyed) or not any(begins[k] in NAME_KEYS for k in bare)
    if not has_names and len(bare) > 1 and _is_any_number(data[0][0]):
        keyed += bare
    return {begins[k]: k for k in keyed}


def _has_settings(row: Sequence[str]) -> bool:
    """Whether a row has a number for each column behind its first cell."""
    return len(row) > 1 and not _is_any_number(row[0]) and all(_is_any_number(cell) for cell in row[1:] if cell)


def _keyed_names(
    rows: Rows, keys: dict[str, int], name_row: int, data: Rows
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of a head with a key in the first cell of each row, above a column of its own or none."""
    width = len(data[0])
    unit_row = next((keys[key] for key in UNIT_KEYS if key in keys), None)
    plain = [["", *row[1:]] if len(row) <= width else row[1:] for row in rows]
    names, units = _padded(plain, name_row, width), _padded(plain, unit_row, width)
    if not names[0] and data[0][0]:
        names[0] = "column 1"
    return tuple(names), tuple(_strip_unit(unit) for unit in units)


def _best_names(rows: Rows, candidates: Sequence[int], unit_row: int | None) -> int | None:
    """The row of names: the last one with texts in most columns, above the row of units where there is one.

    Rows of remarks have few texts, those of statistics numbers, those of settings the same word in all columns.
    """
    texts = {k: [cell for cell in rows[k] if cell and (cell.isdigit() or not _is_any_number(cell))] for k in candidates}
    most = max((len(cells) for cells in texts.values()), default=0)
    various = min(2, max((len(set(cells)) for cells in texts.values()), default=0))
    good = [k for k in candidates if 2 * len(texts[k]) >= most and len(set(texts[k])) >= various]
    above = [k for k in good if unit_row is not None and k < unit_row]
    return next(reversed(above or good), None)


def _is_any_number(cell: str) -> bool:
    return is_number(cell, ".") or is_number(cell, ",")


def _completed(names: list[str], above: Sequence[list[str]]) -> list[str]:
    """The names, those that lack taken from the nearest row above that has one."""
    if not any(names):
        return names
    return [name or next((row[k] for row in above if row[k]), "") for k, name in enumerate(names)]


def _distinguished(pairs: list[tuple[str, str | None]], above: Rows) -> list[tuple[str, str | None]]:
    """Names with their units; equal ones from the nearest row above that tells them apart, such as that of channels."""
    names = [name for name, _ in pairs]
    equal = [k for k, name in enumerate(names) if name and names.count(name) > 1]
    for row in above:
        cells = [row[k] for k in equal]
        if len(set(cells)) == len(cells) and not any(_is_value(cell) for cell in cells):
            own = dict(zip(equal, (split_quotient(cell) for cell in cells), strict=True))
            units = [unit or own.get(k, ("", None))[1] for k, (_, unit) in enumerate(pairs)]
            return [(own[k][0] if k in own else names[k], unit) for k, unit in enumerate(units)]
    return pairs


def _is_value(cell: str) -> bool:
    """Whether a cell of a head is empty, or a number or a time, and no name."""
    return not cell or _is_any_number(cell) or bool(CLOCK.match(cell))


def _shift(names: Sequence[str], data: Rows, width: int) -> int:
    """By how many columns the names stand too far left: a first column of row numbers, or an empty one, has none."""
    if len(names) != width - 1 or not any(row[-1] for row in data if len(row) == width):
        return 0
    first = [row[0] for row in data if row]
    if not any(first) or counts_rows(first):
        return 1
    fault = f"has {len(names)} names above rows of {width} cells"
    remedy = "Give each column a name, or state `name_row` under `text` in the map, counted from the left"
    raise UserError(fault, remedy=remedy)


def counts_rows(cells: Sequence[str]) -> bool:
    """Whether cells are 0, 1, 2 ... or 1, 2, 3 ... ; three of them at least."""
    begin = int(cells[0]) if cells and cells[0] in ("0", "1") else -1
    return len(cells) > 2 and begin >= 0 and list(cells) == [str(begin + k) for k in range(len(cells))]


def _padded(rows: Rows, row: int | None, width: int, shift: int = 0) -> list[str]:
    if row is None or not 0 <= row < len(rows):
        return [""] * width
    cells = [*[""] * shift, *rows[row]][:width]
    return cells + [""] * (width - len(cells))


def _strip_unit(text: str) -> str:
    return "" if text.strip() in NO_UNIT else text.strip().strip("[]()").strip()
