"""Summaries as JSON: numpy and dataclass values become plain ones, non-finite numbers become null."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def json_text(summary: Mapping[str, Any]) -> str:
    """The summary as one JSON object, keys in their given order; bytes of paths that are not UTF-8 are escaped."""
    text = json.dumps(to_json_value(summary), indent=2, ensure_ascii=False, allow_nan=False)
    return text.encode("utf-8", "backslashreplace").decode()


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
