"""Numeric members of structures and cell arrays of MAT files, with the name and unit of the signal beside them."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any, NamedTuple

import numpy as np

DEEPEST = 8
"""Levels of nested structures and cell arrays."""
MOST_ELEMENTS = 1000
"""Elements of an array of structures or cells that are listed; a record has fewer channels."""
NAME_FIELDS = frozenset({"name", "label", "channel", "channelname", "channel_name", "signalname", "function_record"})
"""Text, or a structure with such text: `Name` of dSPACE, `function_record.name` of Testlab."""
UNIT_FIELDS = frozenset({"unit", "units", "unitname", "quantity"})
"""The same for units: `quantity.label` of Testlab."""


class Member(NamedTuple):
    """A member by its place, such as `rec.Y[3].Data`; `label` and `unit` are empty where the file states none."""

    name: str
    values: Any
    label: str = ""
    unit: str = ""


def members(name: str, value: Any, label: str = "", unit: str = "", depth: int = 0) -> Iterator[Member]:
    """Yield the numeric members of structures and cell arrays: `rec.force`, `channel[2].data`, `runs[1]`.

    Name and unit of a signal are those that stand in its structure, or in one that holds it.
    """
    dtype = np.asarray(value).dtype if not isinstance(value, np.void) else value.dtype
    fields = dtype.names
    if fields is None and dtype.kind != "O":
        yield Member(name, value, label, unit)
    elif depth < DEEPEST:
        elements = value.ravel(order="F") if isinstance(value, np.ndarray) else [value]
        for k, element in enumerate(elements[:MOST_ELEMENTS]):
            own = name if len(elements) == 1 else f"{name}[{k + 1}]"
            if fields is None:
                yield from members(own, element, label, unit, depth + 1)
                continue
            called = _stated_text(element, NAME_FIELDS) or label
            measured_in = _stated_text(element, UNIT_FIELDS, NAME_FIELDS) or unit
            for item in fields:
                yield from members(f"{own}.{item}", element[item], called, measured_in, depth + 1)


def _stated_text(value: Any, words: Collection[str], within: Collection[str] | None = None, depth: int = 0) -> str:
    """Return a text, or that in a field of a structure with one of these names; empty where there is none.

    `within`: names of fields of structures in such a field, by default the same.
    """
    while isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    if isinstance(value, str):
        return " ".join(value.split())
    if not isinstance(value, np.void) or not value.dtype.names or depth > 2:
        return ""
    texts = (
        _stated_text(value[field], within or words, depth=depth + 1)
        for field in value.dtype.names
        if field.lower() in words
    )
    return next(filter(None, texts), "")
