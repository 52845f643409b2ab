"""Recognition of files by their content, not by their name."""

from __future__ import annotations

import errno
import os
import re
from pathlib import Path

from balance_cli.io.errors import UserError
from balance_cli.io.formats import IMPORT_FORMAT, PLAN_FORMAT
from balance_cli.io.reader_process import read_in_child

HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
SIGNATURE_OFFSETS = (0, 512, 1024, 2048, 4096)
"""Places of the signature behind a user block, such as that of a MATLAB file; the format allows further doubling."""
SNIFF_BYTES = 65536
"""Bytes at the start of a YAML file that are searched for the `format` key."""


def sniff_format(path: Path) -> str | None:
    """The `format` that a file declares (HDF5 root attribute, or key of a YAML file), else None."""
    if not path.is_file():
        return None
    if is_hdf5(path):
        return _hdf5_format(path)
    return _yaml_format(path)


def implied_format(path: Path) -> str | None:
    """The format of a YAML file that declares none, by its keys: a plan of runs or a map of an import; else None."""
    if not path.is_file() or path.suffix.lower() not in (".yaml", ".yml"):
        return None
    with path.open("rb") as file:
        keys = set(re.findall(rb"^([a-z_]+)\s*:", file.read(SNIFF_BYTES), re.MULTILINE))
    if b"runs" not in keys:
        return None
    return IMPORT_FORMAT if b"channels" in keys else PLAN_FORMAT


def is_hdf5(path: Path) -> bool:
    """Whether the file begins with the HDF5 signature, or has it behind a user block.

    What is not an ordinary file is not opened.
    """
    if not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            head = file.read(SIGNATURE_OFFSETS[-1] + len(HDF5_SIGNATURE))
    except OSError:
        return False
    return any(head.startswith(HDF5_SIGNATURE, offset) for offset in SIGNATURE_OFFSETS)


def describe_file(path: Path) -> str:
    """A noun phrase for messages that says what the file at `path` is."""
    if path.is_dir():
        return "a folder"
    if not path.is_file():
        return "not an ordinary file"
    if path.stat().st_size == 0:
        return "an empty file"
    declared = sniff_format(path)
    if declared is not None:
        return f"a file of format `{declared}`"
    return "an HDF5 file without a readable `format`" if is_hdf5(path) else "not an HDF5 file"


def require_file(path: Path) -> None:
    """Raise UserError where nothing is at `path`, or it cannot be read."""
    try:
        path.stat()
    except FileNotFoundError as error:
        raise UserError("there is no such file", str(path), remedy="Check the name") from error
    except (OSError, ValueError) as error:
        raise _unreadable_error(path, error) from error
    if not os.access(path, os.R_OK):
        raise _unreadable_error(path, PermissionError(errno.EACCES, os.strerror(errno.EACCES)))


def _unreadable_error(path: Path, error: OSError | ValueError) -> UserError:
    reason = getattr(error, "strerror", None) or str(error)
    return UserError(f"cannot be read: {reason}", str(path), remedy="Check its name and permissions")


def _hdf5_format(path: Path) -> str | None:
    try:
        return _read_hdf5_format(path)
    except UserError:
        return None


@read_in_child
def _read_hdf5_format(path: Path) -> str | None:
    import h5py

    try:
        with h5py.File(path, "r") as file:
            return attribute_text(file.attrs.get("format"))
    except (OSError, RuntimeError, ValueError, KeyError, TypeError):
        return None


def _yaml_format(path: Path) -> str | None:
    try:
        with path.open("rb") as file:
            text = file.read(SNIFF_BYTES).decode("utf-8", "replace")
    except OSError:
        return None
    for line in text.splitlines():
        key, colon, value = line.partition(":")
        if colon and key.strip() == "format":
            return value.split("#")[0].strip().strip("'\"") or None
    return None


def attribute_text(value: object) -> str | None:
    """An HDF5 attribute as text, with invalid UTF-8 replaced; None where it is not text.

    Text of a fixed length, which h5py reads as bytes, is filled up with blanks by programs in Fortran and MATLAB. An
    array of one entry, which MATLAB and C write as well, counts as that entry.
    """
    import numpy as np

    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.ravel()[0]
    if isinstance(value, bytes):
        value = value.rstrip(b" \0")
    if isinstance(value, str):
        value = value.encode("utf-8", "surrogateescape")
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else None
