"""Import of scipy without parts of numpy that no command uses, and with the docstrings that it has."""

from __future__ import annotations

from contextlib import suppress
from importlib import import_module

UNUSED = {"f2py", "testing"}
"""The generator of Fortran wrappers and the tools for tests. numpy imports them when they are first asked for."""
NEWEST_SCIPY = (1, 17)
"""The newest scipy whose private modules are known (tried with 1.15 to 1.17); a later one is imported as it is."""


def import_lean_scipy() -> None:
    """Let scipy copy the names of numpy without the unused ones, and leave the docstrings of its functions alone.

    At its import scipy copies every name of numpy to a module of its own, and so imports all of numpy; and it parses
    two hundred docstrings to add to each which array libraries the function supports. Of the time that a command takes
    to start, 50 ms of 560 went into these. numpy itself is left as it was.
    """
    import numpy
    import scipy

    if tuple(int(part) for part in scipy.__version__.split(".")[:2]) > NEWEST_SCIPY:
        return

    namespace = vars(numpy)
    kept = {key: namespace[key] for key in ("__all__", "__dir__")}
    names = [name for name in dir(numpy) if name not in UNUSED]
    namespace.update(__all__=[name for name in numpy.__all__ if name not in UNUSED], __dir__=lambda: names)
    try:
        with suppress(ImportError):  # private modules: another scipy may do without them
            import_module("scipy._lib.array_api_compat.numpy")
            vars(import_module("scipy._lib._array_api"))["FunctionDoc"] = _UnparsedDocstring
    finally:
        namespace.update(kept)


class _UnparsedDocstring(dict[str, list[str]]):
    """The docstring of a function where scipy expects it by sections; what is appended to these is dropped."""

    def __init__(self, function: object) -> None:
        super().__init__(Notes=[])
        self._text = function.__doc__

    def __str__(self) -> str:
        return f"\n{self._text}"  # scipy drops the first line, which is the signature
