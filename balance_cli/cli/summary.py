"""Summaries as JSON: numpy and dataclass values become plain ones, non-finite numbers become null."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

V = TypeVar("V")


STREAMED_DEPTH = 2
"""Levels of mappings whose items are written one by one: the keys of a summary, and the runs within one of them."""


class SummaryOfEach(Mapping[str, Any]):
    """The summaries of the values of a mapping, each made when it is asked for: those of 10 000 runs take 200 MB."""

    def __init__(self, values: Mapping[str, V], summarize: Callable[[V], Any]) -> None:
        self._values, self._summarize = values, summarize

    def __getitem__(self, key: str) -> Any:
        return self._summarize(self._values[key])

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)


def json_parts(summary: Mapping[str, Any]) -> Iterator[str]:
    """Yield the text of a summary, one JSON object with its keys in their order, in parts: it need not be in memory.

    Bytes of paths that are not UTF-8 are escaped.
    """
    for part in _parts(summary, 0):
        yield part.encode("utf-8", "backslashreplace").decode()


def _parts(value: Any, level: int) -> Iterator[str]:
    """Yield the JSON of a value at a level of the object, as `json.dumps` with an indent of two indents it."""
    margin = "\n" + "  " * level
    if level >= STREAMED_DEPTH or not isinstance(value, Mapping) or not len(value):
        text = json.dumps(to_json_value(value), indent=2, ensure_ascii=False, allow_nan=False)
        yield text.replace("\n", margin)
        return
    for position, key in enumerate(value):
        yield f"{',' if position else '{'}{margin}  {json.dumps(str(key), ensure_ascii=False)}: "
        yield from _parts(value[key], level + 1)
    yield margin + "}"


def to_json_value(value: Any) -> Any:
    """`value` reduced to dict, list, str, int, float, bool and None.

    NaN and infinities become None, a complex number becomes {"real", "imag"}. Raises TypeError for any other type.
    """
    if value is None or isinstance(value, bool | str | int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, complex):
        return {"real": to_json_value(value.real), "imag": to_json_value(value.imag)}
    return _plain_container(value)


def _plain_container(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): to_json_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [to_json_value(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_json_value(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if hasattr(value, "tolist"):
        return to_json_value(value.tolist())
    raise TypeError(f"{type(value).__name__} has no JSON form")
