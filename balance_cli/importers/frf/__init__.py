"""Measured frequency responses in the files of other programs: universal files, MAT, HDF5 and tables."""

from __future__ import annotations

from pathlib import Path

from balance_cli.importers import uff as time_records
from balance_cli.importers.base import SNIFFED_BYTES, TextLayout
from balance_cli.importers.frf.functions import FrfFile
from balance_cli.importers.frf.uff import open_uff
from balance_cli.importers.frf.variables import Variables, open_variables
from balance_cli.io.errors import UserError
from balance_cli.io.sniff import describe_file, require_file


def open_frf(path: Path, layout: TextLayout | None = None) -> FrfFile | Variables:
    """Open a file with frequency responses by its content: functions of a universal file, or named arrays.

    Raises UserError where it has none, or is damaged.
    """
    try:
        require_file(path)
        if not path.is_file() or not path.stat().st_size:
            raise UserError(f"is {describe_file(path)}, where responses were expected", remedy="Give a data file")
        with path.open("rb") as file:
            head = file.read(SNIFFED_BYTES)
        if time_records.sniff(path, head):
            return open_uff(path)
        return open_variables(path, layout or TextLayout())
    except UserError as error:
        raise error.with_location(file=str(path)) from error
    except OSError as error:
        raise UserError(f"cannot be read: {error.strerror or error}", str(path), remedy="Check the file") from error
