"""Frozen dataclasses <-> trees of arrays and scalars, by their type hints; trees <-> HDF5; digest of a tree.

A tree is a dict whose values are trees, numpy arrays, strings, numbers, bools or None. Type hints map to trees so:

- `ndarray` (real, complex or text), `str`, `int`, `float`, `complex`, `bool`, `None` and `X | None`: itself;
- `tuple[X, ...]` of scalars: a one-dimensional array; of any other type: a tree with keys 0, 1, ...;
- `dict[str, X]` (or with int keys): a tree with those keys, their order kept; of any other mapping, on demand;
- a dataclass: a tree of its fields; a field that is missing in the tree takes its default;
- a pydantic model such as `Geometry`: its JSON text.
"""

from __future__ import annotations

import dataclasses
import hashlib
import types
import typing
from collections.abc import Iterator, Mapping
from typing import Any
from urllib.parse import unquote

import h5py
import numpy as np
from pydantic import BaseModel

from balance_cli.io.hdf5_links import keeps_values_elsewhere
from balance_cli.io.text_output import storable_text

Tree = dict[str, Any]
SCALARS = (bool, int, float, complex, str)
COMPRESSION_THRESHOLD = 4096
"""Bytes from which a dataset is compressed; below, the overhead of chunks exceeds the gain."""
LARGEST_DEFLATION = 1100.0
"""Ratio of declared to stored bytes; deflate reaches 1032 at most."""
MOST_TREE_BYTES = 2**30
"""Of all datasets of a tree together; the largest results have some hundred megabytes."""


class TreeOnDemand(Tree):
    """A tree of many parts, each of which is made from its value when it is asked for, and not kept."""

    def __init__(self, values: Mapping[Any, Any]) -> None:
        super().__init__({storable_text(str(key)): key for key in values})
        self._values = values

    def __getitem__(self, key: str) -> Any:
        return to_tree(self._values[super().__getitem__(key)])

    def items(self) -> Iterator[tuple[str, Any]]:  # type: ignore[override]
        """Yield each key with its part."""
        return ((key, self[key]) for key in self)


# ---- dataclass -> tree -----------------------------------------------------------------------------------------------


def stored_field_name(item: dataclasses.Field[Any]) -> str:
    """The name of a field in files: `metadata["stored_as"]`, which stays when the field is renamed, or its own name."""
    return str(item.metadata.get("stored_as", item.name))


def _is_omitted(item: dataclasses.Field[Any], value: Any) -> bool:
    """Whether a field that came later is left out, so that results without it keep their digest."""
    return value is None and bool(item.metadata.get("omit_if_none"))


def to_tree(value: Any) -> Any:
    """The value as a tree. Raises TypeError for a type that cannot be stored in an artefact."""
    if isinstance(value, np.generic) or (isinstance(value, np.ndarray) and value.ndim == 0):
        return to_tree(value.item())
    if isinstance(value, str):
        return storable_text(value)
    if value is None or isinstance(value, SCALARS):
        return value
    if isinstance(value, np.ndarray):
        return _require_storable_array(value)
    return _container_to_tree(value)


def _container_to_tree(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return value.model_dump_json(exclude_none=True)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        pairs = ((item, getattr(value, item.name)) for item in dataclasses.fields(value))
        return {stored_field_name(item): to_tree(part) for item, part in pairs if not _is_omitted(item, part)}
    if isinstance(value, dict):
        return {storable_text(str(key)): to_tree(item) for key, item in value.items()}
    if isinstance(value, Mapping):
        return TreeOnDemand(value)
    if isinstance(value, tuple | list):
        return _sequence_to_tree(value)
    raise TypeError(f"{type(value).__name__} cannot be stored in an artefact")


def _sequence_to_tree(items: tuple[Any, ...] | list[Any]) -> Any:
    kinds = {type(item.item() if isinstance(item, np.generic) else item) for item in items}
    if items and (kinds == {int, float} or (len(kinds) == 1 and kinds <= set(SCALARS))):
        return _require_storable_array(np.array(items, dtype=object if kinds == {str} else None))
    return {str(index): to_tree(item) for index, item in enumerate(items)}


def _require_storable_array(array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    if array.dtype.kind in "biufc":
        return array
    if array.dtype.kind in "OU" and all(isinstance(item, str) for item in array.flat):
        return np.array([storable_text(item) for item in array.flat], object).reshape(array.shape)
    raise TypeError(f"an array of {array.dtype} cannot be stored in an artefact")


# ---- tree -> dataclass -----------------------------------------------------------------------------------------------


def from_tree(tree: Any, hint: Any) -> Any:
    """The inverse of `to_tree` for a value of this type hint.

    Raises ValueError, KeyError or TypeError where the tree does not fit the hint.
    """
    origin = typing.get_origin(hint)
    if origin is typing.Annotated:
        return from_tree(tree, typing.get_args(hint)[0])
    if origin in (typing.Union, types.UnionType):
        return _from_union(tree, typing.get_args(hint))
    if origin is tuple:
        return _to_tuple(tree, typing.get_args(hint))
    if origin in (dict, Mapping):
        key, item = typing.get_args(hint)
        return {key(name): from_tree(value, item) for name, value in _as_tree(tree).items()}
    if origin is typing.Literal or hint is Any:
        return tree
    return _from_class(tree, origin or hint)


def _from_union(tree: Any, options: tuple[Any, ...]) -> Any:
    if tree is None:
        return None
    rest = [option for option in options if option is not type(None)]
    if len(rest) == 1:
        return from_tree(tree, rest[0])
    if isinstance(tree, SCALARS) and type(tree) in rest:
        return tree
    return from_tree(tree, next(option for option in rest if _fits_outer_form(option, tree)))


def _fits_outer_form(option: Any, tree: Any) -> bool:
    """Whether a tree can have this type, judged by its outermost level alone."""
    origin = typing.get_origin(option) or option
    if isinstance(tree, dict):
        fields = (
            {stored_field_name(item) for item in dataclasses.fields(option)}
            if dataclasses.is_dataclass(option)
            else None
        )
        return fields == set(tree) if fields is not None else origin in (dict, Mapping, tuple)
    return (origin in (np.ndarray, tuple)) if isinstance(tree, np.ndarray) else origin in SCALARS


def _to_tuple(tree: Any, hints: tuple[Any, ...]) -> tuple[Any, ...]:
    items = tree.tolist() if isinstance(tree, np.ndarray) else list(_as_tree(tree).values())
    repeated = len(hints) == 2 and hints[1] is Ellipsis
    each = [hints[0]] * len(items) if repeated else list(hints)
    return tuple(from_tree(item, hint) for item, hint in zip(items, each, strict=True))


def _from_class(tree: Any, kind: Any) -> Any:
    if kind is np.ndarray:
        return np.asarray(tree) if isinstance(tree, SCALARS) else _require_type(tree, np.ndarray)
    if kind in SCALARS:
        return _scalar(tree, kind)
    if dataclasses.is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        names = {stored_field_name(item): item.name for item in dataclasses.fields(kind)}
        values = {names[name]: from_tree(value, hints[names[name]]) for name, value in _as_tree(tree).items()}
        return typing.cast(Any, kind)(**values)
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return kind.model_validate_json(_require_type(tree, str))
    raise TypeError(f"{kind} cannot be stored in an artefact")


def _scalar(tree: Any, kind: Any) -> Any:
    if kind is float and type(tree) is int:
        return float(tree)
    return _require_type(tree, kind)


def _require_type(tree: Any, kind: type) -> Any:
    if not isinstance(tree, kind) or (isinstance(tree, bool) and kind is not bool):
        raise ValueError(f"{type(tree).__name__} where {kind.__name__} was expected")
    return tree


def _as_tree(tree: Any) -> Tree:
    result: Tree = _require_type(tree, dict)
    return result


# ---- tree <-> HDF5 ---------------------------------------------------------------------------------------------------


def write_tree(group: h5py.Group, tree: Tree) -> None:
    """Write a tree into an empty group."""
    for key, value in tree.items():
        name = _link_name(key)
        if isinstance(value, dict):
            write_tree(group.create_group(name, track_order=True), value)
        elif value is None:
            group.create_dataset(name, data=h5py.Empty("f8"))
        elif isinstance(value, np.ndarray):
            text = h5py.string_dtype() if value.dtype == object else None
            is_large = value.nbytes >= COMPRESSION_THRESHOLD and value.ndim
            large = {"compression": "gzip", "shuffle": True} if is_large else {}
            group.create_dataset(name, data=value, dtype=text, **large)
        else:
            group.create_dataset(name, data=value, dtype=h5py.string_dtype() if isinstance(value, str) else None)


def read_tree(group: h5py.Group) -> Tree:
    """The inverse of `write_tree`; the whole tree is read into memory.

    Raises ValueError, before anything large is read, where the tree is too large or is not one.
    """
    return _read_group(group, {group.id: group.name}, [0])


def _read_group(group: h5py.Group, ancestors: dict[Any, str], size: list[int]) -> Tree:
    """The tree of a group; `ancestors` are the groups that contain it, `size` the bytes so far."""
    tree: Tree = {}
    for name in group:
        if not isinstance(group.get(name, getlink=True), h5py.HardLink) or keeps_values_elsewhere(group[name]):
            raise ValueError(f"{group.name}/{name} is a link to elsewhere")
        item = group[name]
        if isinstance(item, h5py.Group):
            if item.id in ancestors:
                raise ValueError(f"{group.name}/{name} is a link to the group {ancestors[item.id]}")
            tree[_key_of_link(name)] = _read_group(item, {**ancestors, item.id: item.name}, size)
        else:
            size[0] += require_stored_values(item)
            if size[0] > MOST_TREE_BYTES:
                raise ValueError(f"{item.name} and what is before it declare {size[0]} bytes")
            tree[_key_of_link(name)] = _value(item)
    return tree


def require_stored_values(dataset: h5py.Dataset) -> int:
    """Return the bytes that a dataset declares. Raises ValueError where the file is too small to hold them."""
    declared, stored = dataset.nbytes if dataset.shape is not None else 0, dataset.id.get_storage_size()
    if declared > LARGEST_DEFLATION * (stored + COMPRESSION_THRESHOLD):
        raise ValueError(f"{dataset.name} declares {declared} bytes, of which {stored} are stored")
    return int(declared)


def _value(dataset: h5py.Dataset) -> Any:
    text = h5py.check_string_dtype(dataset.dtype) is not None
    value = dataset.asstr()[()] if text and dataset.shape is not None else dataset[()]
    if isinstance(value, h5py.Empty):
        return None
    return value.item() if isinstance(value, np.generic) else value


def _link_name(key: str) -> str:
    """A key as the name of an HDF5 link, which must not be empty, contain `/` or be `.`."""
    if key in ("", "."):
        return {"": "%", ".": "%2E"}[key]
    return key.replace("%", "%25").replace("/", "%2F")


def _key_of_link(name: str) -> str:
    return "" if name == "%" else unquote(name)


# ---- digest ----------------------------------------------------------------------------------------------------------


def tree_digest(tree: Tree) -> str:
    """Hex SHA-256 of a tree, independent of the order of its keys and of how it was stored."""
    hashed = hashlib.sha256()
    for part in _digest_parts(tree, ""):
        hashed.update(len(part).to_bytes(8, "little"))
        hashed.update(part)
    return hashed.hexdigest()


def _digest_parts(value: Any, place: str) -> Iterator[bytes]:
    yield place.encode()
    if isinstance(value, dict):
        yield b"tree"
        for key in sorted(value):
            yield from _digest_parts(value[key], f"{place}/{_link_name(key)}")
    elif isinstance(value, np.ndarray):
        yield from _array_digest_parts(value)
    else:
        yield f"{type(value).__name__}:{value!r}".encode()


def _array_digest_parts(array: np.ndarray[Any, Any]) -> Iterator[bytes]:
    yield repr((array.dtype.kind, array.shape)).encode()
    if array.dtype == object:
        yield from (str(item).encode() for item in array.flat)
    else:
        yield np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes()
