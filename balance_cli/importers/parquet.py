"""Parquet files, read by pyarrow."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from balance_cli.importers.base import (
    Array,
    ChannelGroup,
    ForeignChannel,
    ForeignFile,
    TextLayout,
    errors_as_damage,
    require_package,
)
from balance_cli.io.errors import UserError
from balance_cli.io.units import split_quotient

NAME = "Parquet"


def sniff(path: Path, head: bytes) -> bool:
    """Whether it begins with the mark of Parquet."""
    return head[:4] == b"PAR1"


def open_file(path: Path, layout: TextLayout) -> ForeignFile:
    """List the columns of numbers; a unit in brackets behind a name is its unit."""
    parquet, types = (require_package(f"pyarrow.{part}", NAME, "pyarrow") for part in ("parquet", "types"))
    with errors_as_damage(), parquet.ParquetFile(path) as file:
        fields = [
            field.name
            for field in file.schema_arrow
            if types.is_integer(field.type) or types.is_floating(field.type) or types.is_timestamp(field.type)
        ]
        rows = [file.metadata.row_group(k).num_rows for k in range(file.num_row_groups)]
    if not fields or sum(rows) < 2:
        raise UserError("has no columns of numbers with samples", remedy="Save one column for each channel")
    ends = np.cumsum([0, *rows])

    def read(columns: Sequence[int], start: int, stop: int) -> Array:
        first, last = (int(np.searchsorted(ends, at, side="right")) - 1 for at in (start, stop - 1))
        return _read(path, [fields[k] for k in columns], range(first, last + 1), start - int(ends[first]), stop - start)

    channels = tuple(ForeignChannel(name, unit or "") for name, unit in map(split_quotient, fields))
    return ForeignFile(path, NAME, (ChannelGroup(channels, int(ends[-1]), read),))


def _read(path: Path, names: Sequence[str], row_groups: Sequence[int], start: int, count: int) -> Array:
    """`count` rows of some columns, from row `start` of the first of these row groups on."""
    import pyarrow.parquet as parquet

    with errors_as_damage(path), parquet.ParquetFile(path) as file:
        table = file.read_row_groups(list(row_groups), columns=list(dict.fromkeys(names)), use_threads=False)
        return np.column_stack([_numbers(table[name].slice(start, count)) for name in names])


def _numbers(column: Any) -> Array:
    """A column as numbers, missing values as NaN, time stamps as seconds from 1970."""
    values = column.to_numpy()
    if values.dtype.kind == "M":
        return np.asarray((values - np.datetime64(0, "s")) / np.timedelta64(1, "s"))
    return np.asarray(values, np.float64)
