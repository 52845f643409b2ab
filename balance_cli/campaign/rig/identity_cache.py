"""Values that follow from a frozen object alone, kept for the objects that were asked for last."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import lru_cache, wraps
from typing import Any, TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., Any])

MAX_KEPT = 16
"""Objects kept: two threads fit one geometry each, and a fit asks for the same one hundreds of times."""


class _Identity:
    """An object that equals itself alone; held, so that no other object can take its place in memory."""

    __slots__ = ("subject",)

    def __init__(self, subject: Any) -> None:
        self.subject = subject

    def __hash__(self) -> int:
        return id(self.subject)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Identity) and self.subject is other.subject


def cached_by_identity(function: Function) -> Function:
    """Return the function with its values kept; the first argument must be frozen, the others hashable.

    The first argument is compared by identity: to compare or hash a geometry by content takes as long as most of what
    is computed from it. Callers must not change the values.
    """

    @lru_cache(maxsize=MAX_KEPT)
    def kept(identity: _Identity, *further: Hashable) -> Any:
        return function(identity.subject, *further)

    @wraps(function)
    def cached(subject: Any, *further: Hashable) -> Any:
        return kept(_Identity(subject), *further)

    return cast(Function, cached)
