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
    as_numbers,
    errors_as_damage,
    require_package,
)
from balance_cli.io.column_heads import split_quotient
from balance_cli.io.errors import UserError

NAME = "Parquet"


def sniff(path: Path, head: bytes) -> bool:
    """Whether it begins with the mark of Parquet."""
    return head[:4] == b"PAR1"


def open_file(path: Path, layout: TextLayout) -> ForeignFile:
    """List the columns of numbers; a unit in brackets behind a name is its unit."""
    parquet, types = (require_package(f"pyarrow.{part}", NAME, "pyarrow") for part in ("parquet", "types"))
    with errors_as_damage(), parquet.ParquetFile(path) as file:
        read_types = (types.is_integer, types.is_floating, types.is_decimal, types.is_boolean, types.is_temporal)
        is_number = {field.name: any(is_type(field.type) for is_type in read_types) for field in file.schema_arrow}
        kinds = {field.name: str(field.type) for field in file.schema_arrow}
        in_seconds = {field.name for field in file.schema_arrow if types.is_temporal(field.type)}
        index = (file.schema_arrow.pandas_metadata or {}).get("index_columns", [])
        rows = [file.metadata.row_group(k).num_rows for k in range(file.num_row_groups)]
    # pandas stores its index behind the columns, and a clock among them is the time of the others.
    fields = sorted((name for name, is_read in is_number.items() if is_read), key=lambda name: name not in index)
    if not fields or sum(rows) < 2:
        raise UserError("has no columns of numbers with samples", remedy="Save one column for each channel")
    ends = np.cumsum([0, *rows])

    def read(columns: Sequence[int], start: int, stop: int) -> Array:
        first, last = (int(np.searchsorted(ends, at, side="right")) - 1 for at in (start, stop - 1))
        return _read(path, [fields[k] for k in columns], range(first, last + 1), start - int(ends[first]), stop - start)

    channels = tuple(
        ForeignChannel(name, "s" if field in in_seconds else unit or "")
        for field, (name, unit) in zip(fields, map(split_quotient, fields), strict=True)
    )
    others = (
        ChannelGroup((ForeignChannel(name),), int(ends[-1]), read, unusable=f"of type {kinds[name]}")
        for name, is_read in is_number.items()
        if not is_read
    )
    return ForeignFile(path, NAME, (ChannelGroup(channels, int(ends[-1]), read), *others))


def _read(path: Path, names: Sequence[str], row_groups: Sequence[int], start: int, count: int) -> Array:
    """`count` rows of some columns, from row `start` of the first of these row groups on."""
    import pyarrow.parquet as parquet

    with errors_as_damage(path), parquet.ParquetFile(path) as file:
        table = file.read_row_groups(list(row_groups), columns=list(dict.fromkeys(names)), use_threads=False)
        return np.column_stack([_numbers(table[name].slice(start, count)) for name in names])


def _numbers(column: Any) -> Array:
    """A column as numbers, missing values as NaN, time stamps as seconds from 1970, durations and times as seconds."""
    import pyarrow

    if pyarrow.types.is_decimal(column.type):
        column = column.cast(pyarrow.float64())
    elif pyarrow.types.is_time(column.type):
        column = column.cast(pyarrow.time64("ns")).cast(pyarrow.int64()).cast(pyarrow.duration("ns"))
    return as_numbers(column.to_numpy())
