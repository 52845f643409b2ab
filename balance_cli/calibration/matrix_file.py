"""Reading of matrix files (`balance-matrix/1`) from disk."""

from __future__ import annotations

import hashlib
from pathlib import Path

from balance_cli.calibration.matrix_reader import ParsedMatrix, read_matrix
from balance_cli.io.errors import UserError
from balance_cli.io.sniff import describe_file, require_file

MAX_BYTES = 10_000_000
"""Size from which a file is refused unread: a matrix of six loads and 100 channels has less than 1 MB."""


def read_matrix_file(path: Path) -> tuple[ParsedMatrix, str]:
    """Read a matrix file; returns the matrix and the hex SHA-256 of the file.

    Raises UserError for its first fault.
    """
    require_file(path)
    if not path.is_file():
        raise UserError(
            f"is {describe_file(path)}, where a matrix was expected", str(path), remedy="Give a matrix as .csv"
        )
    if path.stat().st_size > MAX_BYTES:
        raise UserError("is too large for a matrix", str(path), remedy="Give a matrix as .csv")
    try:
        content = path.read_bytes()
        text = content.decode("utf-8")
    except OSError as error:
        reason = error.strerror or str(error)
        raise UserError(f"cannot be read: {reason}", str(path), remedy="Check its permissions") from error
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        fault = f"is not UTF-8 text ({describe_file(path)})"
        raise UserError(fault, str(path), f"line {line}", "Save it as CSV in UTF-8") from error
    try:
        return read_matrix(text), hashlib.sha256(content).hexdigest()
    except UserError as error:
        raise error.with_location(file=str(path)) from error
