"""Arguments of the interface, compared with the annotations of its functions.

The command line checks its words before it calls a step; a step may assume that they are right. Without the same check
a path given as the response passed for the word `static`, and an unknown method for one of the others.
"""

from __future__ import annotations

import collections.abc
import functools
import inspect
import math
import os
import types
import typing
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin

from balance_cli.io.errors import UserError

P = ParamSpec("P")
T = TypeVar("T")

ONE_BY_ONE = (collections.abc.Iterable, collections.abc.Sequence)
"""Annotations of several values: text is a sequence of letters, and never meant as one."""


@dataclass(frozen=True)
class Range:
    """Limits of a number, for `Annotated`; only finite numbers are within them, with `is_open` not the limits."""

    least: float = -math.inf
    most: float = math.inf
    is_open: bool = False

    def __contains__(self, value: float) -> bool:
        within = self.least < value < self.most if self.is_open else self.least <= value <= self.most
        return within and math.isfinite(value)

    def __str__(self) -> str:
        if self.most == math.inf:
            return f"{self.least:g} or more, and finite"
        return f"{'between' if self.is_open else 'from'} {self.least:g} {'and' if self.is_open else 'to'} {self.most:g}"


def check_arguments(function: Callable[P, T]) -> Callable[P, T]:
    """Decorate a function so that its arguments are compared with their annotations before it is called.

    Raises TypeError for an argument of another type, UserError for a word or a number that is not offered. The items of
    iterables are left to the function: they may be read only once.
    """
    signature = inspect.signature(function)

    @functools.wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> T:
        expected = _annotations(function)
        for name, value in signature.bind(*args, **kwargs).arguments.items():
            _check(name, value, expected[name])
        return function(*args, **kwargs)

    return checked


@functools.cache
def _annotations(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the annotations of the parameters, which are text until they are asked for."""
    return typing.get_type_hints(function, include_extras=True)


def _check(name: str, value: Any, expected: Any) -> None:
    """Raise TypeError or UserError where a value does not agree with an annotation."""
    kinds = _alternatives(expected)
    if any(_agrees(value, kind) for kind in kinds):
        return
    words = [word for kind in kinds for word in _words(kind)]
    # What is no word may be a file only where results are meant, which are given as objects.
    is_file = isinstance(value, str | os.PathLike) and any(map(_is_class_of_ours, kinds))
    if words and isinstance(value, str) and not is_file:
        raise UserError(f"`{value}` is not one of {', '.join(words)}", name, remedy="Choose one of them")
    limits = [limit for kind in kinds for limit in _limits(kind) if _agrees(value, get_args(kind)[0])]
    if limits:
        raise UserError(f"must be {limits[0]}, not {value}", name, remedy="Correct it")
    hint = ". Read a file of results by `load_artefact`" if is_file else ""
    accepted = " or ".join(dict.fromkeys(map(_describe, kinds)))
    raise TypeError(f"`{name}` must be {accepted}, not {type(value).__name__}{hint}")


def _alternatives(expected: Any) -> tuple[Any, ...]:
    """Return the members of a union, or the annotation alone."""
    if get_origin(expected) in (Union, types.UnionType):
        return tuple(kind for member in get_args(expected) for kind in _alternatives(member))
    return (expected,)


def _limits(kind: Any) -> tuple[Range, ...]:
    return tuple(kind.__metadata__) if get_origin(kind) is typing.Annotated else ()


def _agrees(value: Any, kind: Any) -> bool:
    """Whether a value is of the kind that an annotation without alternatives describes."""
    origin = get_origin(kind)
    if origin is typing.Annotated:
        return _agrees(value, get_args(kind)[0]) and all(value in limit for limit in _limits(kind))
    if origin is Literal:
        return isinstance(value, str) and value in get_args(kind)
    if origin is tuple:
        return _is_tuple_of(value, get_args(kind))
    if origin in ONE_BY_ONE:
        return isinstance(value, Iterable) and not isinstance(value, str | bytes)
    if kind in (int, float):
        number = Integral if kind is int else Real
        return isinstance(value, number) and not isinstance(value, bool) and not math.isnan(value)
    return kind is Any or isinstance(value, origin or kind)


def _is_tuple_of(value: Any, kinds: tuple[Any, ...]) -> bool:
    """Whether a value is a tuple, list or array of these kinds of items."""
    if isinstance(value, str | bytes) or not isinstance(value, Iterable):
        return False
    items = tuple(value)
    return len(items) == len(kinds) and all(map(_agrees, items, kinds))


def _words(kind: Any) -> tuple[str, ...]:
    return get_args(kind) if get_origin(kind) is Literal else ()


def _is_class_of_ours(kind: Any) -> bool:
    return inspect.isclass(kind) and kind.__module__.startswith("balance_cli.")


def _describe(kind: Any) -> str:
    """Return an annotation as a user would call it."""
    origin = get_origin(kind)
    if origin is Literal:
        return " or ".join(f'"{word}"' for word in _words(kind))
    if origin is typing.Annotated:
        return _describe(get_args(kind)[0])
    if origin is tuple:
        return f"{len(get_args(kind))} numbers"
    if origin in ONE_BY_ONE:
        return "a list"
    names = {int: "a whole number", float: "a number", str: "text", bool: "True or False", type(None): "None"}
    return names.get(kind) or str((origin or kind).__name__)
