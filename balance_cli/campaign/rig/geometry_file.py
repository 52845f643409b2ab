"""Geometry files in YAML: reading with all faults named by file, place and remedy, writing, and digests."""

from __future__ import annotations

import difflib
import hashlib
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_checks import geometry_faults
from balance_cli.io.atomic import atomic_write
from balance_cli.io.errors import UserError
from balance_cli.io.formats import GEOMETRY_FORMAT
from balance_cli.io.sniff import describe_file, is_hdf5, require_file
from balance_cli.io.yaml_file import read_yaml

Place = tuple[int | str, ...]


def load_geometry(path: Path) -> Geometry:
    """The geometry declared in a YAML file. Raises UserError for its first fault."""
    geometry, faults = read_geometry(path)
    if geometry is None or faults:
        raise faults[0]
    return geometry


def read_geometry(path: Path) -> tuple[Geometry | None, tuple[UserError, ...]]:
    """The geometry in a YAML file, if it can be read, and all its faults."""
    try:
        geometry, faults = _parse(_read_yaml(Path(path)))
    except UserError as error:
        return None, (error.with_location(file=str(path)),)
    return geometry, tuple(fault.with_location(file=str(path)) for fault in faults)


def save_geometry(path: Path, geometry: Geometry) -> None:
    """Write a geometry as YAML, whole or not at all."""
    text = yaml.safe_dump(geometry_to_dict(geometry), sort_keys=False, allow_unicode=True, default_flow_style=None)
    with atomic_write(Path(path)) as part:
        part.write_text(text, encoding="utf-8")


def geometry_to_dict(geometry: Geometry) -> dict[str, Any]:
    """The geometry as plain dicts, lists, numbers and strings; keys that are not set are left out."""
    plain: dict[str, Any] = geometry.model_dump(mode="json", exclude_none=True)
    return plain


def geometry_from_dict(declared: object) -> Geometry:
    """The inverse of `geometry_to_dict`, with all checks. Raises UserError for the first fault."""
    geometry, faults = _parse(declared)
    if geometry is None or faults:
        raise faults[0]
    return geometry


def geometry_digest(geometry: Geometry) -> str:
    """Hex SHA-256 of the content: equal for two files that declare the same geometry in different form."""
    text = json.dumps(geometry_to_dict(geometry), sort_keys=True, ensure_ascii=False, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _parse(declared: object) -> tuple[Geometry | None, tuple[UserError, ...]]:
    if not isinstance(declared, dict):
        raise UserError(
            "is not a geometry: no keys in it", remedy=f"The first line should be `format: {GEOMETRY_FORMAT}`"
        )
    if declared.get("format", GEOMETRY_FORMAT) != GEOMETRY_FORMAT or not set(declared) & set(Geometry.model_fields):
        problem = f"is `{declared['format']}`" if "format" in declared else "is missing"
        raise UserError(f"`format` {problem}", place="format", remedy=f"It should be `format: {GEOMETRY_FORMAT}`")
    try:
        geometry = Geometry.model_validate(declared)
    except ValidationError as error:
        return None, _validation_faults(error.errors(include_url=False))
    return geometry, tuple(geometry_faults(geometry))


def _read_yaml(path: Path) -> object:
    require_file(path)
    if not path.is_file() or is_hdf5(path):
        raise UserError(
            f"is {describe_file(path)}, where a geometry was expected", remedy="Give the YAML file of the rig"
        )
    return read_yaml(path, "a geometry")


# ---- faults that pydantic finds --------------------------------------------------------------------------------------


PLAIN_MESSAGES = {
    "tuple_type": "should be a list of values",
    "model_type": "should be keys with values",
    "too_short": "has too few entries",
    "too_long": "has too many entries",
}
"""Replacements of the validator's messages that use Python terms."""


def _validation_faults(details: Sequence[ErrorDetails]) -> tuple[UserError, ...]:
    """All faults, unknown keys first, because a misspelt key explains a missing one.

    A list with an invalid entry is not reported as too short.
    """
    places = [detail["loc"] for detail in details]
    distinct = [
        detail
        for detail in details
        if detail["type"] != "too_short" or not any(_is_within(place, detail["loc"]) for place in places)
    ]
    return tuple(_fault(detail) for detail in sorted(distinct, key=lambda detail: detail["type"] != "extra_forbidden"))


def _is_within(place: Place, outer: Place) -> bool:
    return len(place) > len(outer) and place[: len(outer)] == outer


def _fault(detail: ErrorDetails) -> UserError:
    place, kind = detail["loc"], detail["type"]
    dotted = dotted_place(place)
    if kind == "extra_forbidden":
        return _unknown_key(place)
    if kind == "missing":
        missing = f"`{place[-1]}` is missing" if isinstance(place[-1], str) else "this entry is missing"
        return UserError(missing, place=dotted, remedy="Add it")
    if kind == "value_error":
        return UserError(str(detail["ctx"]["error"]), place=dotted, remedy="Correct this entry")
    message = PLAIN_MESSAGES.get(kind) or detail["msg"].removeprefix("Input ")
    return UserError(f"{message} (found {_shorten_repr(detail['input'])})", place=dotted, remedy="Correct this value")


def _shorten_repr(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def dotted_place(place: Iterable[int | str]) -> str:
    """A place in a file as in `cells[3].stiffness`."""
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place)
    return text.removeprefix(".")


def _unknown_key(place: Place) -> UserError:
    key, known = str(place[-1]), _known_keys(place[:-1])
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.0)
    remedy = f"The nearest known key is `{near[0]}`" if near else "Remove it"
    return UserError(f"unknown key `{key}`", place=dotted_place(place), remedy=remedy)


def _known_keys(place: Place) -> tuple[str, ...]:
    """The keys that the part at `place` may have."""
    part: Any = Geometry
    for step in place:
        if isinstance(step, str) and isinstance(part, type) and issubclass(part, BaseModel):
            part = _part_within(part.model_fields[step].annotation)
    return tuple(part.model_fields) if isinstance(part, type) and issubclass(part, BaseModel) else ()


def _part_within(annotation: Any) -> Any:
    """The model inside `Model | None`, `tuple[Model, ...]` and the like."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    if get_origin(annotation) in (tuple, Union, UnionType):
        inner = (_part_within(argument) for argument in get_args(annotation))
        return next((part for part in inner if part is not None), None)
    return None
