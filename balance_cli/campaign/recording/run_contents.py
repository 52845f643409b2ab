"""Reading of everything in a run file but its samples; sizes are checked before anything is read."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from balance_cli.campaign.recording.conditions import RUN_ATTRIBUTES, read_conditions
from balance_cli.campaign.recording.dataset_checks import MOST_PULSES, PULSE_DATASET, is_loadable
from balance_cli.campaign.recording.point_labels import MOST_LABELS, LabelDataset, label_texts
from balance_cli.campaign.recording.reading_units import EXCITATION
from balance_cli.campaign.recording.run import Array
from balance_cli.campaign.recording.run_schema import DatasetLayout, RunFileContents
from balance_cli.io.errors import UserError
from balance_cli.io.formats import RUN_FORMAT
from balance_cli.io.hdf5_links import linked_object
from balance_cli.io.sniff import attribute_text, describe_file, is_hdf5, require_file

MOST_ATTRIBUTE_ENTRIES = 10_000
"""Entries of an attribute; no rig has so many channels."""
LEFT_EMPTY = ("loads", "attitude", "series", "point", EXCITATION)
"""Datasets that a writer of all kinds of runs leaves empty where there is nothing to store: as good as absent."""


@contextmanager
def report_damage(path: Path) -> Iterator[None]:
    """Turn whatever h5py raises for a truncated or damaged file into one UserError."""
    try:
        yield
    except (OSError, RuntimeError, LookupError, ValueError, TypeError, AttributeError, MemoryError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        fault = f"cannot be read, it is truncated or damaged ({reason})"
        raise UserError(fault, str(path), remedy="Copy it again from where it was recorded") from error


def read_contents(path: Path) -> RunFileContents:
    """Read everything in a run file but the samples.

    Raises UserError where the file is not a run file, or is damaged.
    """
    require_file(path)
    if not is_hdf5(path):
        raise _not_a_run_error(path)
    with report_damage(path), h5py.File(path, "r") as file:
        attributes = _read_attributes(file, RUN_ATTRIBUTES)
        if attributes.get("format") != RUN_FORMAT:
            raise _not_a_run_error(path)
        channels = _read_layout(file, "channels", "unit")
        pulses, attitude = _read_layout(file, PULSE_DATASET, "unit"), _read_layout(file, "attitude", "unit")
        rows = channels.shape[0] if channels is not None and channels.shape else 0
        return RunFileContents(
            attributes,
            channels=channels,
            loads=_read_layout(file, "loads", "units"),
            pulses=pulses,
            pulse_times=_read_values(file, PULSE_DATASET, pulses, MOST_PULSES),
            attitude=attitude,
            angles=_read_values(file, "attitude", attitude, rows),
            has_load_points="load_points" in file,
            series=_read_labels(file, "series"),
            point=_read_labels(file, "point"),
            conditions=read_conditions(file),
            excitation=_read_layout(file, EXCITATION, "unit"),
            channel_excitation=None
            if channels is None
            else _read_attributes(file["channels"], (EXCITATION,)).get(EXCITATION),
        )


def _not_a_run_error(path: Path) -> UserError:
    return UserError(
        f"is {describe_file(path)}, where a run file (`{RUN_FORMAT}`) was expected", remedy="Give a run file"
    )


def _read_values(file: h5py.File, name: str, layout: DatasetLayout | None, most_rows: int) -> Array | None:
    return np.asarray(file[name][()]) if is_loadable(layout, most_rows) else None


def _read_labels(file: h5py.File, name: str) -> LabelDataset | None:
    layout = _read_layout(file, name, "unit")
    if layout is None:
        return None
    loadable = layout.is_complete and len(layout.shape) == 1 and layout.shape[0] <= MOST_LABELS
    return LabelDataset(layout.shape, layout.kind, label_texts(file[name][()]) if loadable else None)


def _read_layout(file: h5py.File, name: str, units: str) -> DatasetLayout | None:
    """Read the layout of a dataset; `units` names the attribute that holds its unit or units."""
    try:
        dataset = linked_object(file, name)
    except (OSError, RuntimeError, LookupError) as error:
        fault = f"cannot be read: {' '.join(str(error).split())}"
        raise UserError(fault, place=name, remedy="Write it as a dataset, not as a link") from error
    if dataset is None:
        return None
    if not isinstance(dataset, h5py.Dataset):
        raise UserError("is not a dataset", place=name, remedy="Write it as a dataset")
    if dataset.shape is None or (name in LEFT_EMPTY and dataset.size == 0):
        return None
    attributes = _read_attributes(dataset, ("names", units))
    shape = tuple(dataset.shape)
    return DatasetLayout(
        shape,
        dataset.dtype.kind,
        names=_as_texts(attributes.get("names")),
        units=_as_texts(attributes.get(units)),
        is_complete=_is_complete(dataset, shape),
        declared_bytes=math.prod(shape) * dataset.dtype.itemsize,
        stored_bytes=dataset.id.get_storage_size(),
    )


def _is_complete(dataset: h5py.Dataset, shape: tuple[int, ...]) -> bool:
    """Whether all values were written; HDF5 reads those that were not as zeros."""
    if dataset.chunks is None:
        stored, needed = dataset.id.get_storage_size(), math.prod(shape) * dataset.dtype.itemsize
    else:
        chunks = (-(-size // chunk) for size, chunk in zip(shape, dataset.chunks, strict=True))
        stored, needed = dataset.id.get_num_chunks(), math.prod(chunks)
    return bool(stored >= needed)


def _read_attributes(item: h5py.File | h5py.Dataset, names: Iterable[str]) -> dict[str, Any]:
    """Those of the named attributes that are there; ValueError where one is longer than any can be (a damaged file)."""
    values = {}
    stored = item.attrs  # of a file, every call opens its root
    for name in names:
        if name in stored:
            if math.prod(stored.get_id(name).shape or ()) > MOST_ATTRIBUTE_ENTRIES:
                raise ValueError(f"attribute {name} claims too many entries")
            values[name] = _native_value(stored[name])
    return values


def _native_value(value: Any) -> Any:
    """An attribute as text (what is not UTF-8 replaced), number, or list of several; one entry counts as a scalar."""
    if isinstance(value, bytes | str):
        return attribute_text(value)
    if isinstance(value, np.ndarray):
        entries = [_native_value(item) for item in value.ravel().tolist()]
        return entries[0] if len(entries) == 1 else entries
    return value.item() if isinstance(value, np.generic) else value


def _as_texts(value: Any) -> tuple[str, ...]:
    items = [value] if isinstance(value, str) else value
    return tuple(str(item) for item in items) if isinstance(items, list | tuple) else ()
