"""Files on object stores and servers, by the URLs that fsspec reads (s3://, gs://, https:// and others)."""

from __future__ import annotations

import hashlib
import importlib
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from balance_cli.io.errors import UserError

URL = re.compile(r"([a-z][a-z0-9+.-]+):/+(.+)", re.DOTALL)
"""A scheme of at least two letters, so that no drive of Windows is one; a path has lost one of the two slashes."""
LOCAL_SCHEMES = ("file", "local")


def store_url(path: Path) -> str | None:
    """Return the URL that a path on the command line stands for; None for the path of a file."""
    match = URL.fullmatch(path.as_posix())
    if match is None:
        return None
    scheme, name = match.groups()
    return f"{scheme}:///{name}" if scheme in LOCAL_SCHEMES else f"{scheme}://{name}"


@contextmanager
def local_copy(url: str) -> Iterator[Path]:
    """Yield a copy of a file of a store, which is removed afterwards.

    Raises UserError where fsspec or the package of the store is not installed, and where the file cannot be read.
    """
    system, key = _open_store(url)
    with TemporaryDirectory(prefix="balance-") as folder:
        copy = Path(folder) / "run.h5"
        try:
            system.get_file(key, str(copy))
        except Exception as error:  # each store raises what its own client does
            raise _store_error(url, error) from error
        yield copy


def store_stamp(url: str) -> str:
    """Return a text that changes with the file of a store: a digest of what the store states of it."""
    try:
        system, key = _open_store(url)
        return hashlib.sha256(repr(sorted(system.info(key).items())).encode()).hexdigest()
    except Exception:  # whatever it is, the reading of the file reports it
        return "absent"


def _open_store(url: str) -> tuple[Any, str]:
    """Return the file system of a URL, and the name of the file in it."""
    try:
        core = importlib.import_module("fsspec.core")
    except ImportError:
        raise UserError(
            "fsspec is not installed", url, remedy="Install it: pip install 'balance-cli[fsspec]'"
        ) from None
    try:
        system, key = core.url_to_fs(url)
    except Exception as error:  # an unknown scheme, a package that is missing, no credentials
        raise _store_error(url, error) from error
    return system, str(key)


def _store_error(url: str, error: Exception) -> UserError:
    if isinstance(error, FileNotFoundError):
        return UserError("there is no such file", url, remedy="Check the URL")
    reason = " ".join(str(error).split()) or type(error).__name__
    return UserError(f"cannot be read from the store: {reason}", url, remedy="Check the URL and the access to it")
