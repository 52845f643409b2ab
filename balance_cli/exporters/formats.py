"""The formats of `balance export`: by name, by the ending of a file, and how each is written."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

from balance_cli.exporters.cubes import Cube, cubes_of
from balance_cli.exporters.tables import Columns, csv_text, long_columns, long_table, wide_columns
from balance_cli.io.artefacts import Artefact
from balance_cli.io.errors import UserError
from balance_cli.io.text_output import storable_text

SUFFIXES = {
    ".csv": "csv",
    ".parquet": "parquet",
    ".mat": "mat",
    ".uff": "uff",
    ".unv": "uff",
    ".h5": "nexus",
    ".hdf5": "nexus",
    ".nxs": "nexus",
    ".nc": "netcdf",
}
"""Format by the ending of the name of a file."""
FORMATS = tuple(dict.fromkeys(SUFFIXES.values()))
TABLES = ("csv", "parquet")
"""Formats that may be long or wide."""


def export_bytes(artefact: Artefact, format: str, wide: bool) -> bytes:
    """Return an artefact in one of FORMATS. UserError where the format cannot hold it."""
    if wide and format not in TABLES:
        raise UserError(f"a table in the format {format} is not wide", "--wide", remedy="Write .csv or .parquet")
    writers: dict[str, Callable[[Artefact], bytes]] = {
        "csv": lambda item: storable_text(csv_text(_columns(item.content, wide))).encode(),
        "parquet": lambda item: _parquet(item.content, wide),
        "mat": _mat,
        "uff": _uff,
        "nexus": _nexus,
        "netcdf": _netcdf,
    }
    return writers[format](artefact)


def _columns(content: Any, wide: bool) -> Columns:
    return wide_columns(content) if wide else long_columns(content)


def _parquet(content: Any, wide: bool) -> bytes:
    try:
        import pyarrow  # noqa: F401
    except ImportError as error:
        remedy = "Install it: pip install 'balance-cli[formats]'"
        raise UserError("needs the package pyarrow", "format parquet", remedy=remedy) from error
    import pandas as pd

    table = pd.DataFrame(wide_columns(content)) if wide else long_table(content)
    for name in [str(column) for column in table.columns if table[column].dtype.kind == "c"]:
        values = table.pop(name)
        table[f"{name}_real"], table[f"{name}_imag"] = values.to_numpy().real, values.to_numpy().imag
    buffer = io.BytesIO()
    table.to_parquet(buffer, index=False)
    return buffer.getvalue()


def _mat(artefact: Artefact) -> bytes:
    from balance_cli.exporters.mat import mat_bytes

    return mat_bytes(cubes_of(artefact.content), long_table(artefact.content))


def _uff(artefact: Artefact) -> bytes:
    from balance_cli.exporters.uff import uff_text
    from balance_cli.exporters.uff_history import history_uff_text
    from balance_cli.reduction.stored_history import StoredHistory
    from balance_cli.signals.response.transfer import Transfer

    if isinstance(artefact.content, StoredHistory):
        return history_uff_text(artefact.content, artefact.provenance.created).encode("ascii")
    if not isinstance(artefact.content, Transfer):
        fault = f"a universal file holds frequency responses or histories, not `{artefact.format}`"
        raise UserError(fault, "format uff", remedy="Give the result of `sweep-tf`, or choose another format")
    return uff_text(artefact.content, artefact.provenance.created).encode("ascii")


def _cubes(artefact: Artefact, format: str) -> tuple[Cube, ...]:
    cubes = cubes_of(artefact.content)
    if not cubes:
        fault = f"holds histories, loads, spectra and frequency responses, not `{artefact.format}`"
        raise UserError(fault, f"format {format}", remedy="Write .csv, .parquet or .mat")
    return cubes


def _nexus(artefact: Artefact) -> bytes:
    from balance_cli.exporters.nexus import nexus_bytes

    return nexus_bytes(_cubes(artefact, "nexus"), f"balance {artefact.provenance.command}")


def _netcdf(artefact: Artefact) -> bytes:
    from balance_cli.exporters.datasets import netcdf_bytes

    return netcdf_bytes(_cubes(artefact, "netcdf"))
