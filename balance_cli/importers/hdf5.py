"""HDF5 files: those of MATLAB 7.3, and any other with datasets of numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from balance_cli.importers.base import Array, ChannelGroup, ForeignChannel, ForeignFile, TextLayout, damaged
from balance_cli.importers.matrices import scalar_of
from balance_cli.io.errors import UserError
from balance_cli.io.reader_process import read_in_child
from balance_cli.io.sniff import HDF5_SIGNATURE, attribute_text

NAME = "HDF5"
MATLAB_BLOCK = 512
"""Bytes before the HDF5 part of a MATLAB 7.3 file."""
MOST_DATASETS = 10_000
UNIT_ATTRIBUTES = ("unit", "units", "Unit", "Units", "UNITS")
NAME_ATTRIBUTES = ("names", "channel_names", "columns")
RATE_ATTRIBUTES = ("sample_rate", "sampling_rate", "fs", "SampleRate", "sampleRate", "sampling_frequency")
MATLAB_HIDDEN = ("#refs#", "#subsystem#")


def sniff(path: Path, head: bytes) -> bool:
    """Whether the HDF5 signature stands at the start, or behind the block of MATLAB."""
    return head.startswith(HDF5_SIGNATURE) or head[MATLAB_BLOCK : MATLAB_BLOCK + 8] == HDF5_SIGNATURE


@dataclass(frozen=True)
class _Listed:
    """A dataset of the file: its path, its name as shown, shape, names and units of its columns, sample rate [Hz]."""

    path: str
    shown: str
    shape: tuple[int, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    rate: float | None


def open_file(path: Path, layout: TextLayout) -> ForeignFile:
    """List the datasets of numbers with one or two dimensions."""
    listed, scalars, recorded = _list_datasets(path)
    if not listed:
        raise UserError("has no dataset of numbers with samples", remedy="Save the records as datasets")
    return ForeignFile(path, NAME, tuple(_group(path, item) for item in listed), recorded=recorded, scalars=scalars)


@read_in_child
def _list_datasets(path: Path) -> tuple[list[_Listed], dict[str, float], str | None]:
    """The datasets with samples, the single numbers, and the time of recording."""
    import h5py

    listed: list[_Listed] = []
    scalars: dict[str, float] = {}

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and not name.startswith(MATLAB_HIDDEN) and len(listed) < MOST_DATASETS:
            _add(name, item, listed, scalars)

    try:
        with h5py.File(path, "r") as file:
            file.visititems(visit)
            return listed, scalars, attribute_text(file.attrs.get("recorded"))
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        raise damaged(error) from error


def _add(name: str, item: Any, listed: list[_Listed], scalars: dict[str, float]) -> None:
    shape = tuple(item.shape or ())
    is_matlab = "MATLAB_class" in item.attrs
    is_text = is_matlab and _is_text(item)
    if item.dtype.kind not in "iufb" or len(shape) > 2 or is_text or "MATLAB_empty" in item.attrs:
        return
    shown = name.replace("/", ".") if is_matlab else name
    size = int(np.prod(shape)) if shape else 1
    if size == 1:
        value = scalar_of(item[()])
        if value is not None:
            scalars[shown] = value
    elif size > 1:
        count = 1 if len(shape) == 1 else min(shape)
        units = _texts(item, UNIT_ATTRIBUTES)
        units = units * count if len(units) == 1 else units if len(units) == count else ("",) * count
        listed.append(_Listed(name, shown, shape, _column_names(item, shown, count), units, _rate(item)))


def _is_text(item: Any) -> bool:
    return attribute_text(item.attrs["MATLAB_class"]) == "char"


def _group(path: Path, listed: _Listed) -> ChannelGroup:
    shape, name = listed.shape, listed.path
    by_columns = len(shape) == 1 or shape[0] >= shape[1]

    def read(columns: Sequence[int], start: int, stop: int) -> Array:
        import h5py

        try:
            with h5py.File(path, "r") as file:
                dataset = file[name]
                if len(shape) == 1:
                    part = dataset[start:stop][:, None]
                else:
                    part = dataset[start:stop] if by_columns else dataset[:, start:stop].T
                return np.asarray(part[:, list(columns)], np.float64)
        except (OSError, RuntimeError, KeyError, ValueError) as error:
            raise damaged(error).with_location(file=str(path), place=name) from error

    channels = tuple(ForeignChannel(*pair) for pair in zip(listed.names, listed.units, strict=True))
    return ChannelGroup(channels, max(shape), read, listed.rate)


def _column_names(item: Any, shown: str, count: int) -> tuple[str, ...]:
    names = _texts(item, NAME_ATTRIBUTES)
    if len(names) == count:
        return names
    return (shown,) if count == 1 else tuple(f"{shown}[{k + 1}]" for k in range(count))


def _texts(item: Any, attributes: Sequence[str]) -> tuple[str, ...]:
    for attribute in attributes:
        if attribute in item.attrs:
            value = item.attrs[attribute]
            values = value.ravel().tolist() if isinstance(value, np.ndarray) else [value]
            texts = [attribute_text(text) for text in values]
            if all(text is not None for text in texts):
                return tuple(str(text) for text in texts)
    return ()


def _rate(item: Any) -> float | None:
    """The sample rate [Hz] that the dataset, its group or the file states, else None."""
    for holder in (item, item.parent, item.file):
        for attribute in RATE_ATTRIBUTES:
            rate = scalar_of(holder.attrs[attribute]) if attribute in holder.attrs else None
            if rate is not None and np.isfinite(rate) and rate > 0:
                return rate
    return None
