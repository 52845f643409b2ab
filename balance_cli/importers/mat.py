"""MAT files of MATLAB versions 4 to 7 (7.3 is HDF5: see hdf5)."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from balance_cli.importers.base import Array, ChannelGroup, ForeignChannel, ForeignFile, TextLayout, errors_as_damage
from balance_cli.importers.mat_elements import examine_elements
from balance_cli.importers.mat_members import members
from balance_cli.importers.matrices import matrix_group, scalar_of
from balance_cli.importers.stored_scales import with_scale_beside
from balance_cli.io.errors import UserError

NAME = "MAT"
NUMERIC_CLASSES = {"double", "single", "logical"} | {
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}
LARGEST_HEADER_NUMBER = 4052
"""Of the first number of a version 4 header, which is 1000 M + 100 O + 10 P + T with M <= 4, P <= 5 and T <= 2."""


def sniff(path: Path, head: bytes) -> bool:
    """Whether the header is that of version 5, or of a version 4 matrix in either byte order."""
    if head.startswith(b"MATLAB") and head[124:128] not in (b"", b"\0\2MI", b"\0\2IM"):
        return head[126:128] in (b"MI", b"IM") and head[124:126] in (b"\x00\x01", b"\x01\x00")
    return any(_is_version_4(np.frombuffer(head[:20], f"{order}i4")) for order in "<>") if len(head) >= 20 else False


def _is_version_4(header: Any) -> bool:
    """Type, rows, columns, imaginary flag and length of the name of a version 4 matrix."""
    kind, rows, columns, imaginary, length = (int(value) for value in header)
    digits = (kind // 100 % 10, kind // 10 % 10, kind % 10)
    sound = 0 <= kind <= LARGEST_HEADER_NUMBER and digits[0] == 0 and digits[1] <= 5 and digits[2] <= 2
    return sound and rows >= 0 and columns >= 0 and imaginary in (0, 1) and 1 < length < 256


def open_file(path: Path, layout: TextLayout) -> ForeignFile:
    """List the variables; a matrix is read when its samples are."""
    from scipy.io import whosmat
    from scipy.io.matlab import matfile_version

    with errors_as_damage():
        if matfile_version(str(path))[0] == 1:
            examine_elements(path)
        listed = whosmat(str(path))
    load = cache(lambda name: _load(path, name))  # a compressed variable can only be read whole
    groups: list[ChannelGroup] = []
    scalars: dict[str, float] = {}
    integers: set[str] = set()
    for name, shape, kind in listed:
        if name.startswith("__"):
            continue  # what MATLAB keeps for itself, such as the workspace of functions
        is_matrix = kind in NUMERIC_CLASSES and len(shape) == 2
        if is_matrix and max(shape) > 1 and min(shape) > 0:
            groups.append(_lazy_group(name, shape, load))
        elif kind in NUMERIC_CLASSES and len(shape) > 2:
            groups.append(_unusable(path, name, shape))
        elif kind in ("struct", "cell") or (is_matrix and shape == (1, 1)):
            for member in members(name, load(name)):
                if (value := scalar_of(member.values)) is not None:
                    scalars[member.name] = value
                elif (group := matrix_group(*member)) is not None:
                    groups.append(group)
                    integers |= set(group.names) if np.asarray(member.values).dtype.kind in "iu" else set()
    if not groups:
        raise UserError("has no matrix of numbers with samples", remedy="Save the records as matrices or vectors")
    return ForeignFile(path, NAME, tuple(with_scale_beside(groups, integers, scalars)), scalars=scalars)


def _unusable(path: Path, name: str, shape: tuple[int, ...]) -> ChannelGroup:
    """An array that is listed and cannot be read as a record in time."""

    def read(columns: Sequence[int], start: int, stop: int) -> Array:
        raise UserError("is no matrix", str(path), f"variable {name}", "Leave it out of the map")

    return ChannelGroup((ForeignChannel(name),), shape[0], read, unusable=f"an array of {len(shape)} dimensions")


def _load(path: Path, name: str) -> Any:
    from scipy.io import loadmat

    with errors_as_damage(path, f"variable {name}"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        value = loadmat(str(path), variable_names=[name], struct_as_record=True)[name]
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "iufbVO":
        raise UserError("is sparse, complex or empty", str(path), f"variable {name}", "Leave it out of the map")
    return value


def _lazy_group(name: str, shape: tuple[int, ...], load: Any) -> ChannelGroup:
    """The columns of a matrix as channels, its longer side as time."""
    by_columns = shape[0] >= shape[1]
    count = min(shape)
    names = (name,) if count == 1 else tuple(f"{name}[{k + 1}]" for k in range(count))

    def read(columns: Sequence[int], start: int, stop: int) -> Array:
        matrix = load(name)
        part = matrix[start:stop, list(columns)] if by_columns else matrix[list(columns), start:stop].T
        return np.asarray(part, np.float64)

    return ChannelGroup(tuple(ForeignChannel(channel) for channel in names), max(shape), read)
