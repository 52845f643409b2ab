"""Rows of units above the columns of a text file, also those with units that no reading of a balance has."""

from __future__ import annotations

from collections.abc import Sequence

from balance_cli.importers.scope_heads import counts_samples
from balance_cli.io.other_units import is_other_unit
from balance_cli.io.text_numbers import is_missing, is_number
from balance_cli.io.units import is_unit

UNIT_SHARE = 0.5
"""Share of the cells of a row that must be units for a row of units; names such as `N` or `Mz` are rare."""
UNIT_KEYS = (
    *("unit", "units", "einheit", "einheiten", "y-unit", "y_unit_label", "vunit", "vertical units", "unitname"),
    "単位",
)
"""First cells that say that the others are units; the last is that of Japanese loggers."""
Rows = Sequence[Sequence[str]]


def says_units(row: Sequence[str]) -> bool:
    """Whether the first cell of a row says that the others are units."""
    return bool(row) and row[0].rstrip(":=").lower() in UNIT_KEYS


def are_units(row: Sequence[str]) -> bool:
    """Whether a row is one of units: more than half of its cells are, or half of them and some occur twice.

    A first cell that says what the others are, as LabVIEW writes it, does not count.
    """
    row = row[1:] if says_units(row) or (row and counts_samples(row[0])) else row
    cells = [_bare(cell) for cell in row if cell and not is_missing(cell)]
    units = [cell for cell in cells if is_unit(cell) and not _is_number(cell)]  # settings are numbers, and 1 a unit
    least = UNIT_SHARE * len(cells)
    return len(units) > least or (len(units) >= least and len(set(units)) < len(units))


def are_units_of(row: Sequence[str], names: Sequence[str], data: Rows) -> bool:
    """Whether a row directly below one of different names has a unit for most columns of numbers that it renames.

    One at least must be a unit of loads and readings; the others may be any. Where a column counts the samples or is
    called the same in both rows, the cell says nothing.
    """
    if len(names) != len(row) or not all(names) or len(set(names)) < len(names) or any(map(_is_number, names)):
        return False
    numeric = [k for k in range(len(row)) if _has_numbers(data, k)]
    stated = [_bare(row[k]) for k in numeric if row[k] not in ("", names[k]) and not counts_samples(row[k])]
    known = [cell for cell in stated if is_unit(cell) and not _is_number(cell)]
    others = [cell for cell in stated if cell not in known and is_other_unit(cell)]
    own = sum(is_unit(names[k]) for k in numeric)
    return len(known) > 0 and len(known) + len(others) > max(UNIT_SHARE * len(stated), own)


def _has_numbers(data: Rows, column: int) -> bool:
    cell = next((row[column] for row in data if len(row) > column and not is_missing(row[column])), "")
    return _is_number(cell)


def _is_number(cell: str) -> bool:
    return is_number(cell, ".") or is_number(cell, ",")


def _bare(cell: str) -> str:
    return cell.lstrip("#").strip().strip("[]()").strip()
