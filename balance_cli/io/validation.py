"""Faults of a declared file (geometry, map, plan) as pydantic finds them, in plain terms with place and remedy."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from balance_cli.io.errors import UserError

Place = tuple[int | str, ...]

PLAIN_MESSAGES = {
    "tuple_type": "should be a list of values",
    "model_type": "should be keys with values",
    "too_short": "has too few entries",
    "too_long": "has too many entries",
}
"""Replacements of the validator's messages that use Python terms."""


def validation_faults(model: type[BaseModel], error: ValidationError) -> tuple[UserError, ...]:
    """All faults, unknown keys first, because a misspelt key explains a missing one.

    A list with an invalid entry is not reported as too short.
    """
    details = error.errors(include_url=False)
    places = [detail["loc"] for detail in details]
    distinct = [
        detail
        for detail in details
        if detail["type"] != "too_short" or not any(_is_within(place, detail["loc"]) for place in places)
    ]
    return tuple(
        _fault(model, detail) for detail in sorted(distinct, key=lambda detail: detail["type"] != "extra_forbidden")
    )


def _is_within(place: Place, outer: Place) -> bool:
    return len(place) > len(outer) and place[: len(outer)] == outer


def _fault(model: type[BaseModel], detail: ErrorDetails) -> UserError:
    place, kind = detail["loc"], detail["type"]
    dotted = dotted_place(place)
    if kind == "extra_forbidden":
        return _unknown_key(model, place)
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


def _unknown_key(model: type[BaseModel], place: Place) -> UserError:
    key, known = str(place[-1]), _known_keys(model, place[:-1])
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.0)
    remedy = f"The nearest known key is `{near[0]}`" if near else "Remove it"
    return UserError(f"unknown key `{key}`", place=dotted_place(place), remedy=remedy)


def _known_keys(model: type[BaseModel], place: Place) -> tuple[str, ...]:
    """The keys that the part at `place` may have."""
    part: Any = model
    for step in place:
        if isinstance(step, str) and _is_model(part):
            part = _part_within(part.model_fields[step].annotation)
        elif get_origin(part) is dict:
            part = _part_within(get_args(part)[1])
    return tuple(part.model_fields) if _is_model(part) else ()


def _is_model(part: Any) -> bool:
    return isinstance(part, type) and issubclass(part, BaseModel)


def _part_within(annotation: Any) -> Any:
    """The model (or mapping of models) inside `Model | None`, `tuple[Model, ...]` and the like."""
    if _is_model(annotation) or get_origin(annotation) is dict:
        return annotation
    if get_origin(annotation) in (tuple, Union, UnionType, Annotated):
        inner = (_part_within(argument) for argument in get_args(annotation))
        return next((part for part in inner if part is not None), None)
    return None
