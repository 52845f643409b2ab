"""Import of scipy without parts of numpy that no command uses."""

from __future__ import annotations

from contextlib import suppress
from importlib import import_module

UNUSED = {"f2py", "testing"}
"""The generator of Fortran wrappers and the tools for tests. numpy imports them when they are first asked for."""


def import_lean_scipy() -> None:
    """Let scipy copy the names of numpy without the unused ones.

    At its import scipy copies every name of numpy to a module of its own, and so imports all of numpy: of the time that
    a command takes to start, a tenth went into the two. numpy itself is left as it was.
    """
    import numpy

    namespace = vars(numpy)
    kept = {key: namespace[key] for key in ("__all__", "__dir__")}
    names = [name for name in dir(numpy) if name not in UNUSED]
    namespace.update(__all__=[name for name in numpy.__all__ if name not in UNUSED], __dir__=lambda: names)
    try:
        with suppress(ImportError):  # a private module: another scipy may do without it
            import_module("scipy._lib.array_api_compat.numpy")
    finally:
        namespace.update(kept)
