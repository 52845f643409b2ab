"""HDF5 files: those of MATLAB 7.3, and any other with datasets of numbers."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from balance_cli.importers.base import (
    Array,
    ChannelGroup,
    ForeignChannel,
    ForeignFile,
    TextLayout,
    damage_error,
    select_columns,
)
from balance_cli.importers.matrices import scalar_of
from balance_cli.importers.time_columns import TIME_NAME
from balance_cli.importers.written_numbers import whole_rate
from balance_cli.io.errors import UserError
from balance_cli.io.hdf5_links import keeps_values_elsewhere
from balance_cli.io.reader_process import read_in_child
from balance_cli.io.sniff import HDF5_SIGNATURE, attribute_text

NAME = "HDF5"
MATLAB_BLOCK = 512
"""Bytes before the HDF5 part of a MATLAB 7.3 file."""
MOST_DATASETS = 10_000
UNIT_ATTRIBUTES = ("unit", "units", "Unit", "Units", "UNITS")
NAME_ATTRIBUTES = ("names", "channel_names", "columns")
RATE_ATTRIBUTES = ("sample_rate", "sampling_rate", "fs", "SampleRate", "sampleRate", "sampling_frequency")
STEP_ATTRIBUTES = ("wf_increment", "dt", "delta_t", "sample_interval", "time_step")
"""Attributes with the step [s] instead of the rate; the first is that of LabVIEW."""
MISSING_ATTRIBUTES = ("_FillValue", "missing_value")
"""Of netCDF: the numbers that stand for no value, before `scale_factor` and `add_offset` are applied."""
SINCE = re.compile(r"^(\w+?)s? since ")
"""The unit of times of netCDF: `seconds since 2024-03-12`."""
SINCE_UNITS = {"second": "s", "millisecond": "ms", "microsecond": "us", "minute": "min", "hour": "h"}
MATLAB_HIDDEN = ("#refs#", "#subsystem#")


def sniff(path: Path, head: bytes) -> bool:
    """Whether the HDF5 signature stands at the start, or behind the block of MATLAB."""
    return head.startswith(HDF5_SIGNATURE) or head[MATLAB_BLOCK : MATLAB_BLOCK + 8] == HDF5_SIGNATURE


@dataclass(frozen=True)
class _Listed:
    """A dataset of the file: its path, its name as shown, shape, names and units of its columns, sample rate [Hz].

    `rate_of` is the path of what states the rate. A value is `factor` times the stored one plus `offset`; stored
    numbers in `missing` are none. `field` is the column of a table of named columns.
    """

    path: str
    shown: str
    shape: tuple[int, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    rate: float | None
    rate_of: str = ""
    factor: float = 1.0
    offset: float = 0.0
    missing: tuple[float, ...] = ()
    field: str | None = None


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
        if keeps_values_elsewhere(item):
            raise UserError("has its values in another file", place=name, remedy="Write them into this file")
        if isinstance(item, h5py.Dataset) and not name.startswith(MATLAB_HIDDEN) and len(listed) < MOST_DATASETS:
            _add(name, item, listed, scalars)

    try:
        with h5py.File(path, "r") as file:
            file.visititems(visit)
            return _with_own_rates(listed), scalars, attribute_text(file.attrs.get("recorded"))
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        raise damage_error(error) from error


def _with_own_rates(listed: Sequence[_Listed]) -> list[_Listed]:
    """The datasets; the rate of a group or of the file is that of its longest ones only, shorter ones have another."""
    longest: dict[str, int] = {}
    for item in listed:
        longest[item.rate_of] = max(longest.get(item.rate_of, 0), max(item.shape))
    return [
        replace(item, rate=None) if item.rate_of != item.path and max(item.shape) < longest[item.rate_of] else item
        for item in listed
    ]


def _add(name: str, item: Any, listed: list[_Listed], scalars: dict[str, float]) -> None:
    shape = tuple(item.shape or ())
    is_matlab = "MATLAB_class" in item.attrs
    is_text = is_matlab and _is_text(item)
    if item.dtype.names and len(shape) == 1 and shape[0] > 1 and not is_matlab:
        listed += [_listed(name, item, f"{name}.{field}", field) for field in _number_fields(item.dtype)]
    if item.dtype.kind not in "iufb" or len(shape) > 2 or is_text or "MATLAB_empty" in item.attrs or _is_index(item):
        return
    shown = name.replace("/", ".") if is_matlab else name
    size = int(np.prod(shape)) if shape else 1
    if size == 1:
        value = scalar_of(item[()])
        if value is not None:
            scalars[shown] = value
    elif size > 1:
        listed.append(_listed(name, item, shown))


def _number_fields(dtype: Any) -> list[str]:
    """The columns of numbers in a table of named columns."""
    return [field for field in dtype.names if dtype[field].kind in "iufb" and dtype[field].shape == ()]


def _is_index(item: Any) -> bool:
    """Whether a dataset only numbers another one: a coordinate of netCDF that is no time, an axis of pandas."""
    is_scale = attribute_text(item.attrs.get("CLASS")) == "DIMENSION_SCALE"
    is_time = bool(TIME_NAME.match(item.name) or SINCE.match(attribute_text(item.attrs.get("units")) or ""))
    return (is_scale and not is_time) or re.search(r"/axis\d+$", item.name) is not None


def _listed(name: str, item: Any, shown: str, field: str | None = None) -> _Listed:
    shape = tuple(item.shape)
    count = 1 if len(shape) == 1 else min(shape)
    units = _texts(item, UNIT_ATTRIBUTES)
    units = units * count if len(units) == 1 else units if len(units) == count else ("",) * count
    units = tuple(SINCE_UNITS.get(match[1], unit) if (match := SINCE.match(unit)) else unit for unit in units)
    rate, holder = _rate(item)
    scale = {key: scalar_of(item.attrs[key]) for key in ("scale_factor", "add_offset") if key in item.attrs}
    missing = [scalar_of(item.attrs[key]) for key in MISSING_ATTRIBUTES if key in item.attrs]
    return _Listed(
        *(name, shown, shape, _column_names(item, shown, count), units, rate, holder),
        factor=scale.get("scale_factor") or 1.0,
        offset=scale.get("add_offset") or 0.0,
        missing=tuple(value for value in missing if value is not None and np.isfinite(value)),
        field=field,
    )


def _is_text(item: Any) -> bool:
    return attribute_text(item.attrs["MATLAB_class"]) == "char"


def _group(path: Path, listed: _Listed) -> ChannelGroup:
    shape, name = listed.shape, listed.path
    by_columns = len(shape) == 1 or shape[0] >= shape[1]

    def read(columns: Sequence[int], start: int, stop: int) -> Array:
        import h5py

        try:
            with h5py.File(path, "r") as file:
                dataset = file[name] if listed.field is None else file[name].fields(listed.field)
                if len(shape) == 1:
                    part = dataset[start:stop][:, None]
                else:
                    part = dataset[start:stop] if by_columns else dataset[:, start:stop].T
                return _values(select_columns(part, columns), listed)
        except (OSError, RuntimeError, KeyError, ValueError) as error:
            raise damage_error(error).with_location(file=str(path), place=name) from error

    channels = tuple(ForeignChannel(*pair) for pair in zip(listed.names, listed.units, strict=True))
    return ChannelGroup(channels, max(shape), read, listed.rate)


def _values(stored: Array, listed: _Listed) -> Array:
    """Stored numbers as values."""
    if listed.missing:
        stored[np.isin(stored, listed.missing)] = np.nan
    return stored if (listed.factor, listed.offset) == (1.0, 0.0) else stored * listed.factor + listed.offset


def _column_names(item: Any, shown: str, count: int) -> tuple[str, ...]:
    names = _texts(item, NAME_ATTRIBUTES)
    beside = item.name.removesuffix("_values") + "_items"  # as pandas stores a table
    if not names and item.name.endswith("_values") and beside in item.file:
        names = tuple(str(attribute_text(text)) for text in item.file[beside][:].tolist())
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


def _rate(item: Any) -> tuple[float | None, str]:
    """The sample rate [Hz] that the dataset, its group or the file states, and the path of the one that does."""
    for holder in (item, item.parent, item.file):
        for attribute in (*RATE_ATTRIBUTES, *STEP_ATTRIBUTES):
            value = scalar_of(holder.attrs[attribute]) if attribute in holder.attrs else None
            if value is not None and np.isfinite(value) and value > 0:
                rate = value if attribute in RATE_ATTRIBUTES else whole_rate(1.0 / value)
                return rate, holder.name.lstrip("/")
    return None, ""
