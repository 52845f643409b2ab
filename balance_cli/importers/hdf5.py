"""HDF5 files: those of MATLAB 7.3, and any other with datasets of numbers."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
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
from balance_cli.importers.matlab_members import CLASS, EMPTY, OBJECT, StoredMember, is_text, own_items, stored_members
from balance_cli.importers.matrices import object_fault, scalar_of
from balance_cli.importers.stored_scales import numbers_beside, stated_scale
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
SINCE_UNITS = {"second": "s", "millisecond": "ms", "microsecond": "us", "minute": "min", "hour": "h", "day": "d"}
NUMBERS = "iufb"
"""Kinds of numpy types that hold real numbers."""
MATLAB_HIDDEN = ("#refs#", "#subsystem#")


def sniff(path: Path, head: bytes) -> bool:
    """Whether the HDF5 signature stands at the start, or behind the block of MATLAB."""
    return head.startswith(HDF5_SIGNATURE) or head[MATLAB_BLOCK : MATLAB_BLOCK + 8] == HDF5_SIGNATURE


@dataclass(frozen=True)
class _Listed:
    """A dataset of the file: its path, its name as shown, shape, names and units of its columns, sample rate [Hz].

    `rate_of` is the path of what states the rate. A value is `factor` times the stored one plus `offset`; stored
    numbers in `missing` are none. `field` is the column of a table of named columns, `label` what the signal is called.
    `kind` is that of the stored numbers (numpy), `scale` and `unusable` are as in channels and groups.
    """

    path: str
    shown: str
    shape: tuple[int, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    rate: float | None
    rate_of: str = ""
    label: str = ""
    factor: float = 1.0
    offset: float = 0.0
    missing: tuple[float, ...] = ()
    field: str | None = None
    kind: str = "f"
    scale: str = ""
    unusable: str = ""


def open_file(path: Path, layout: TextLayout) -> ForeignFile:
    """List the datasets of numbers with one or two dimensions."""
    listed, scalars, recorded = _list_datasets(path)
    if not listed:
        raise UserError("has no dataset of numbers with samples", remedy="Save the records as datasets")
    scaled = [_with_scale_beside(item, scalars) for item in listed]
    return ForeignFile(path, NAME, tuple(_group(path, item) for item in scaled), recorded=recorded, scalars=scalars)


@read_in_child
def _list_datasets(path: Path) -> tuple[list[_Listed], dict[str, float], str | None]:
    """The datasets with samples, the single numbers, and the time of recording."""
    import h5py

    listed: list[_Listed] = []
    scalars: dict[str, float] = {}
    found: dict[str, Any] = {}
    classes: list[str] = []

    def visit(name: str, item: Any) -> None:
        if keeps_values_elsewhere(item):
            raise UserError("has its values in another file", place=name, remedy="Write them into this file")
        classes.extend([name] if CLASS in item.attrs else [])
        if isinstance(item, h5py.Dataset) and not name.startswith(MATLAB_HIDDEN) and len(found) < MOST_DATASETS:
            found[name] = item

    try:
        with h5py.File(path, "r") as file:
            file.visititems(visit)
            members = _variables(file) if classes else (StoredMember(name, item) for name, item in found.items())
            for member in islice(members, MOST_DATASETS):
                _add(member, listed, scalars)
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


def _variables(file: Any) -> Iterator[StoredMember]:
    """The members of all variables of MATLAB."""
    for name, item in own_items(file).items():
        if name not in MATLAB_HIDDEN:
            yield from stored_members(name, item)


def _add(member: StoredMember, listed: list[_Listed], scalars: dict[str, float]) -> None:
    shown, item = member.name, member.item
    shape = tuple(item.shape or ())
    is_table = item.dtype.names and len(shape) == 1 and shape[0] > 1 and CLASS not in item.attrs
    if is_table:
        listed += [_listed(member, f"{shown}.{field}", field) for field in _number_fields(item.dtype)]
        listed += [
            replace(_listed(member, f"{shown}.{field}", field), unusable="an array in each row of a table")
            for field in item.dtype.names
            if item.dtype[field].shape != ()
        ]
    if is_text(item) or EMPTY in item.attrs or _is_index(item):
        return
    size = int(np.prod(shape)) if shape else 1
    reason = _unusable(item)
    if reason and size > 1:
        listed.append(replace(_listed(member, shown), names=(shown,), units=("",), unusable=reason))
    elif item.dtype.kind not in NUMBERS:
        return
    elif size == 1:
        value = scalar_of(item[()])
        if value is not None:
            scalars[shown] = value
    elif size > 1:
        listed.append(_listed(member, shown))


def _unusable(item: Any) -> str:
    """Why an array of numbers is no record in time; empty where it is one, and of texts."""
    if OBJECT in item.attrs:  # the numbers only refer to where its values are
        return object_fault(attribute_text(item.attrs.get(CLASS)) or "")
    if item.dtype.kind == "c" or {"real", "imag"} == set(item.dtype.names or ()):
        return "complex numbers"
    return f"an array of {len(item.shape)} dimensions" if item.dtype.kind in NUMBERS and len(item.shape) > 2 else ""


def _with_scale_beside(listed: _Listed, scalars: dict[str, float]) -> _Listed:
    """With the numbers that convert it, its own or those in the group that holds it."""
    beside = listed.kind in "iu" and not listed.unusable and numbers_beside(listed.shown, scalars)
    return replace(listed, scale=listed.scale or stated_scale(beside)) if beside else listed


def _number_fields(dtype: Any) -> list[str]:
    """The columns of numbers in a table of named columns."""
    return [field for field in dtype.names if dtype[field].kind in NUMBERS and dtype[field].shape == ()]


def _is_index(item: Any) -> bool:
    """Whether a dataset only numbers another one: a coordinate of netCDF that is no time, an axis of pandas."""
    is_scale = attribute_text(item.attrs.get("CLASS")) == "DIMENSION_SCALE"
    is_time = bool(TIME_NAME.match(item.name) or SINCE.match(attribute_text(item.attrs.get("units")) or ""))
    return (is_scale and not is_time) or re.search(r"/axis\d+$", item.name) is not None


def _listed(member: StoredMember, shown: str, field: str | None = None) -> _Listed:
    item = member.item
    shape = tuple(item.shape)
    count = 1 if len(shape) == 1 else min(shape)
    units = _texts(item, UNIT_ATTRIBUTES) or ((member.unit,) if member.unit else ())
    units = units * count if len(units) == 1 else units if len(units) == count else ("",) * count
    units = tuple(SINCE_UNITS.get(match[1], unit) if (match := SINCE.match(unit)) else unit for unit in units)
    rate, holder = _rate(item)
    kind = item.dtype.kind if field is None else item.dtype[field].kind
    scale = {key: scalar_of(item.attrs[key]) for key in ("scale_factor", "add_offset") if key in item.attrs}
    others = {key: scalar_of(value) for key, value in item.attrs.items() if key not in scale} if kind in "iu" else {}
    missing = [scalar_of(item.attrs[key]) for key in MISSING_ATTRIBUTES if key in item.attrs]
    return _Listed(
        *(item.name.lstrip("/"), shown, shape, _column_names(item, shown, count), units, rate, holder),
        label=member.label if count == 1 else "",
        factor=scale.get("scale_factor") or 1.0,
        offset=scale.get("add_offset") or 0.0,
        missing=tuple(value for value in missing if value is not None and np.isfinite(value)),
        field=field,
        scale=stated_scale({key: value for key, value in others.items() if value is not None}),
        kind=kind,
    )


def _group(path: Path, listed: _Listed) -> ChannelGroup:
    shape, path_in_file = listed.shape, listed.path
    by_columns = len(shape) == 1 or shape[0] >= shape[1]

    def read(columns: Sequence[int], start: int, stop: int) -> Array:
        import h5py

        try:
            with h5py.File(path, "r") as file:
                dataset = file[path_in_file]
                dataset = dataset if listed.field is None else dataset.fields(listed.field)
                if len(shape) == 1:
                    part = dataset[start:stop][:, None]
                else:
                    part = dataset[start:stop] if by_columns else dataset[:, start:stop].T
                return _values(select_columns(part, columns), listed)
        except (OSError, RuntimeError, KeyError, ValueError) as error:
            raise damage_error(error).with_location(file=str(path), place=path_in_file) from error

    pairs = zip(listed.names, listed.units, strict=True)
    channels = tuple(ForeignChannel(name, unit, listed.label, listed.scale) for name, unit in pairs)
    return ChannelGroup(channels, max(shape), read, listed.rate, unusable=listed.unusable)


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
