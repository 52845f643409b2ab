"""Matrices in memory as groups of channels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from balance_cli.importers.base import Array, ChannelGroup, ForeignChannel, select_columns

FEWEST_SAMPLES = 2


def object_fault(kind: str) -> str:
    """Why an object of MATLAB, such as a timeseries or a table, cannot be read, as `unusable` of its group."""
    return f"an object of MATLAB (`{kind}`), of which only arrays can be read: save its values (x = ts.Data)"


def scalar_of(values: Any) -> float | None:
    """The single real number in an array, else None."""
    array = np.asarray(values)
    if array.size != 1 or array.dtype.kind not in "iufb":
        return None
    return float(array.reshape(-1)[0])


def matrix_group(name: str, values: Any, label: str = "", unit: str = "") -> ChannelGroup | None:
    """The columns of a real matrix as channels, its longer side as time; None for anything else.

    `label` is that of a single column.
    """
    array = np.squeeze(np.asarray(values))
    if array.dtype.kind not in "iufb" or array.ndim not in (1, 2) or array.size < FEWEST_SAMPLES:
        return None
    table = array[:, None] if array.ndim == 1 else array
    table = table if table.shape[0] >= table.shape[1] else table.T
    count = table.shape[1]

    def read(columns: Sequence[int], start: int, stop: int) -> Array:
        return select_columns(table[start:stop], columns)

    if count == 1:
        return ChannelGroup((ForeignChannel(name, unit, label),), len(table), read)
    return ChannelGroup(tuple(ForeignChannel(f"{name}[{k + 1}]", unit) for k in range(count)), len(table), read)
