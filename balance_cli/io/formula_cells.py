"""Names as cells of tables for spreadsheets, which take a cell that begins with certain characters for a formula.

A formula in a name from another file can start programs when the table is opened (CSV injection, CWE-1236). An
apostrophe before the name makes it text, as spreadsheets do themselves.
"""

from __future__ import annotations

import re

_FORMULA = re.compile(r"[=@\t\r]|[+-].*[(|!]")
"""A sign alone begins no harmful formula without a call, a pipe or a reference; `-5deg` remains as it is."""


def text_cell(name: str) -> str:
    """The name as a cell that no spreadsheet takes for a formula."""
    return f"'{name}" if _FORMULA.match(name) else name


def name_of_cell(cell: str) -> str:
    """The name that `text_cell` made a cell of."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell[1:]) else cell
