"""Readers of the files of other programs: one module for each format, found by content.

A format is a module with NAME, `sniff` and `open_file` as in `balance_cli.importers.base.Format`, and one line in
FORMATS. Nothing else names it.
"""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path
from typing import cast

from balance_cli.importers.base import (
    SNIFFED_BYTES,
    ChannelGroup,
    ForeignFile,
    Format,
    TextLayout,
    distinct_names,
    impossible_size,
)
from balance_cli.io.errors import UserError
from balance_cli.io.sniff import describe_file, require_file
from balance_cli.io.text_format import require_plain_text

FORMATS = ("tdms", "mdf", "mat", "hdf5", "wav", "parquet", "uff", "text")
"""Modules in the order in which they are asked. A file of MATLAB 7.3 is also one of HDF5, and any other file may be
text."""

OTHER_FILES = {
    b"\x1f\x8b": ("compressed by gzip", "Unpack it first, by gunzip"),
    b"ARROW1": ("a Feather (Arrow) file", "Save it as Parquet"),
    b"FEA1": ("a Feather (Arrow) file", "Save it as Parquet"),
    **dict.fromkeys(
        (b"CDF\x01", b"CDF\x02", b"CDF\x05"), ("a netCDF-3 file", "Convert it to netCDF-4, by `nccopy -k nc4 IN OUT`")
    ),
}
"""What a file is that begins so and is not imported, and what helps."""


def open_foreign(path: Path, layout: TextLayout | None = None) -> ForeignFile:
    """Open a file of another program by its content. Raises UserError where no format fits, or it is damaged."""
    try:
        require_file(path)
        if not path.is_file() or not path.stat().st_size:
            raise UserError(f"is {describe_file(path)}, where a recording was expected", remedy="Give a data file")
        with path.open("rb") as file:
            head = file.read(SNIFFED_BYTES)
        require_plain_text(head, path)
        opened = _format_of(path, head).open_file(path, layout or TextLayout())
        groups = tuple(_with_possible_size(path, group) for group in opened.groups)
    except UserError as error:
        raise error.with_location(file=str(path)) from error
    except OSError as error:
        raise UserError(f"cannot be read: {error.strerror or error}", str(path), remedy="Check the file") from error
    return replace(opened, groups=distinct_names(groups))


def _with_possible_size(path: Path, group: ChannelGroup) -> ChannelGroup:
    """Return the group, unusable where the file cannot hold it."""
    fault = impossible_size(path, group.samples, len(group.channels))
    return replace(group, unusable=fault) if fault else group


def _format_of(path: Path, head: bytes) -> Format:
    # Before the formats: their zero bytes can be those of a text in UTF-16.
    for mark, (kind, remedy) in OTHER_FILES.items():
        if head.startswith(mark):
            raise UserError(f"is {kind}", remedy=remedy)
    for name in FORMATS:
        module = cast(Format, importlib.import_module(f"{__name__}.{name}"))
        if module.sniff(path, head):
            return module
    known = "CSV or other text, UFF 58, TDMS, MDF4, MAT, HDF5, WAV and Parquet"
    raise UserError("is of no format that can be imported", remedy=f"Export it as one of {known}")
