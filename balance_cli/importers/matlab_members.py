"""Members of structures, arrays of structures and cell arrays in MATLAB 7.3 files.

MATLAB stores an array of structures as a group with one dataset of references for each field, and a cell array as a
dataset of references; what they refer to is in a group of its own. Elements are in the order of MATLAB, because its
arrays are stored transposed.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from balance_cli.importers.mat_members import DEEPEST, MOST_ELEMENTS, NAME_FIELDS, UNIT_FIELDS
from balance_cli.io.hdf5_links import keeps_values_elsewhere
from balance_cli.io.sniff import attribute_text

CLASS = "MATLAB_class"
OBJECT = "MATLAB_object_decode"
"""Attribute of an object: its dataset holds a reference and no values."""
EMPTY = "MATLAB_empty"
"""Attribute of a dataset that only holds the size of an empty array."""
LONGEST_TEXT = 1000
"""Characters of a name or a unit that are read."""


class StoredMember(NamedTuple):
    """A dataset with its name as MATLAB writes it (`chn[2].data`); `label` and `unit` are empty where there is none."""

    name: str
    item: Any
    label: str = ""
    unit: str = ""


def stored_members(
    name: str, item: Any, label: str = "", unit: str = "", depth: int = 0, seen: set[int] | None = None
) -> Iterator[StoredMember]:
    """Yield the datasets of numbers and texts in a variable, as `mat_members.members` does for other versions.

    What was `seen` (addresses in the file) is left out: references of a damaged file may lead to what refers to them.
    """
    seen = set() if seen is None else seen
    if depth > DEEPEST or _address(item) in seen or keeps_values_elsewhere(item) or EMPTY in item.attrs:
        return
    seen.add(_address(item))
    for own, element in _elements(name, item):
        if isinstance(element, dict):
            called = _stated_text(element, NAME_FIELDS) or label
            measured_in = _stated_text(element, UNIT_FIELDS, NAME_FIELDS) or unit
            for field, value in element.items():
                yield from stored_members(f"{own}.{field}", value, called, measured_in, depth + 1, seen)
        elif element is item:
            yield StoredMember(own, item, label, unit)
        else:
            yield from stored_members(own, element, label, unit, depth + 1, seen)


def _address(item: Any) -> int:
    import h5py

    return int(h5py.h5o.get_info(item.id).addr)


def _elements(name: str, item: Any) -> Iterator[tuple[str, Any]]:
    """The elements of a variable with their names: a structure as its fields, what is referred to, or the variable."""
    if not hasattr(item, "items"):
        yield from _numbered(name, _referred(item)) if _is_reference(item) else [(name, item)]
        return
    fields = own_items(item)
    arrays = {field: value for field, value in fields.items() if _is_reference(value) and CLASS not in value.attrs}
    if not arrays:
        yield name, fields
        return
    columns = {field: _referred(value) for field, value in arrays.items()}
    rows = zip(*columns.values(), strict=False)
    yield from _numbered(name, [dict(zip(columns, row, strict=True)) for row in rows])


def own_items(group: Any) -> dict[str, Any]:
    """Return what lies in a group itself, by name: links, which MATLAB does not make, may lead to any other file."""
    import h5py

    return {name: group[name] for name in group if isinstance(group.get(name, getlink=True), h5py.HardLink)}


def _fields(element: Any) -> dict[str, Any] | None:
    """The fields of a structure; None of a dataset."""
    if isinstance(element, dict):
        return element
    return own_items(element) if hasattr(element, "items") else None


def _numbered(name: str, elements: list[Any]) -> Iterator[tuple[str, Any]]:
    """The elements with their numbers from 1; a single one has the name of its array."""
    for k, element in enumerate(elements[:MOST_ELEMENTS]):
        yield (name if len(elements) == 1 else f"{name}[{k + 1}]"), element


def _is_reference(item: Any) -> bool:
    import h5py

    return hasattr(item, "dtype") and h5py.check_ref_dtype(item.dtype) is h5py.Reference


def _referred(item: Any) -> list[Any]:
    """What a dataset of references refers to."""
    return [item.file[reference] for reference in np.ravel(item[()])[:MOST_ELEMENTS] if reference]


def _stated_text(
    fields: Mapping[str, Any], words: Collection[str], within: Collection[str] | None = None, depth: int = 0
) -> str:
    """A text in a field with one of these names, or of a structure in such a field (`within`: names of its fields)."""
    for field, value in fields.items():
        if field.lower() not in words or depth > 2:
            continue
        for _, element in _elements(field, value):
            inner = _fields(element)
            text = text_of(element) if inner is None else _stated_text(inner, within or words, depth=depth + 1)
            if text:
                return text
    return ""


def is_text(item: Any) -> bool:
    """Return whether a dataset holds characters."""
    return attribute_text(item.attrs.get(CLASS)) == "char"


def text_of(item: Any) -> str:
    """Return the text of a dataset of characters; empty where it is none, or no name or unit by its length."""
    if not is_text(item) or EMPTY in item.attrs or item.dtype != np.uint16 or item.size > LONGEST_TEXT:
        return ""
    return " ".join("".join(chr(code) for code in np.ravel(item[()])).split())
