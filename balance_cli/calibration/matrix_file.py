"""Reading of matrix files (`balance-matrix/1`) from disk."""

from __future__ import annotations

import hashlib
from pathlib import Path

from balance_cli.calibration.ati_matrix import read_ati_matrix
from balance_cli.calibration.linear_matrix import LinearMatrix, read_linear_csv
from balance_cli.calibration.matrix_reader import ParsedMatrix, read_matrix
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.load_components import load_components
from balance_cli.io.errors import UserError
from balance_cli.io.sniff import describe_file, require_file
from balance_cli.io.table_text import read_table

MAX_BYTES = 10_000_000
"""Size from which a file is refused unread: a matrix of six loads and 100 channels has less than 1 MB."""


def read_any_matrix(path: Path, geometry: Geometry) -> tuple[ParsedMatrix | LinearMatrix, str]:
    """Read a matrix with all terms (`balance-matrix/1`), or a linear one: plain CSV, or the XML of ATI.

    Returns the matrix and the hex SHA-256 of the file. Raises UserError for its first fault.
    """
    if is_xml(path):
        text, digest = read_text_file(path)
        return read_ati_matrix(text.removeprefix("\ufeff"), str(path)), digest
    if is_matrix_of_all_terms(path):
        return read_matrix_file(path)
    table = read_table(path)
    channels = [channel.name for channel in geometry.channels if channel.measures_dc]
    return read_linear_csv(table, load_components(geometry).names, channels), table.digest


def is_xml(path: Path) -> bool:
    """Whether a file begins as XML does."""
    return _first_bytes(path).lstrip(b"\xef\xbb\xbf \r\n\t").startswith(b"<")


def is_matrix_of_all_terms(path: Path) -> bool:
    """Whether a file begins as `balance-matrix/1` does, or cannot be read: its reader says why."""
    begin = _first_bytes(path)
    return begin.startswith((b"balance-matrix", b"\xef\xbb\xbfbalance-matrix")) or not begin


def _first_bytes(path: Path) -> bytes:
    """The beginning of an ordinary file; empty for anything else, which the reader then refuses."""
    try:
        with path.open("rb") as file:
            return file.read(200)
    except OSError:
        return b""


def read_matrix_file(path: Path) -> tuple[ParsedMatrix, str]:
    """Read a matrix file; returns the matrix and the hex SHA-256 of the file.

    Raises UserError for its first fault.
    """
    text, digest = read_text_file(path)
    try:
        return read_matrix(text), digest
    except UserError as error:
        raise error.with_location(file=str(path)) from error


def read_text_file(path: Path, expected: str = "a matrix", remedy: str = "Give a matrix as .csv") -> tuple[str, str]:
    """The text of a small file, and the hex SHA-256 of the file.

    Raises UserError, with the `remedy`, for anything but the text file that was `expected`.
    """
    require_file(path)
    if not path.is_file():
        raise UserError(f"is {describe_file(path)}, where {expected} was expected", str(path), remedy=remedy)
    if path.stat().st_size > MAX_BYTES:
        raise UserError(f"is too large for {expected}", str(path), remedy=remedy)
    try:
        content = path.read_bytes()
        text = content.decode("utf-8")
    except OSError as error:
        reason = error.strerror or str(error)
        raise UserError(f"cannot be read: {reason}", str(path), remedy="Check its permissions") from error
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        fault = f"is not UTF-8 text ({describe_file(path)})"
        raise UserError(fault, str(path), f"line {line}", "Save it as text in UTF-8") from error
    return text, hashlib.sha256(content).hexdigest()
