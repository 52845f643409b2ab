"""Run files (HDF5, `balance-run/1`): the only reader and writer of raw data."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from balance_cli.campaign.recording.run import Array, Run, SampleBlock, run_digest
from balance_cli.campaign.recording.run_schema import (
    DatasetLayout,
    RunFileContents,
    load_sample_faults,
    run_file_faults,
    run_from_contents,
)
from balance_cli.campaign.rig.attitude import ANGLES
from balance_cli.campaign.rig.components import COMPONENTS, UNITS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.atomic import atomic_write
from balance_cli.io.errors import UserError
from balance_cli.io.formats import RUN_FORMAT
from balance_cli.io.sniff import attribute_text, describe_file, is_hdf5, require_file

CHUNK_ROWS = 4096
MOST_ATTRIBUTE_ENTRIES = 10_000
"""Entries of an attribute; no rig has so many channels."""
RUN_ATTRIBUTES = (
    *("format", "kind", "run", "rig", "sample_rate", "rotor_speed", "excited", "excitation", "level", "period", "trim"),
    *("recorded", "note"),
)


@dataclass(frozen=True)
class Hdf5Source:
    """Samples in a run file, opened anew for each read (so that many runs can be held without open files)."""

    path: Path
    load_order: tuple[int, ...] | None

    def read(self, start: int, stop: int) -> SampleBlock:
        """Samples start to stop. UserError where the file can no longer be read."""
        with report_damage(self.path), h5py.File(self.path, "r") as file:
            channels = np.asarray(file["channels"][start:stop], np.float64)
            if self.load_order is None:
                return SampleBlock(start, channels, None)
            return SampleBlock(start, channels, np.asarray(file["loads"][start:stop], np.float64)[:, self.load_order])


def open_run(path: Path) -> Run:
    """Open a run file; its samples are read once for their digest, then on demand. UserError for its first fault."""
    run, faults = read_run(path)
    if run is None or faults:
        raise faults[0]
    return run


def read_run(path: Path) -> tuple[Run | None, tuple[UserError, ...]]:
    """The run in a file as far as it can be read, and all its faults."""
    path = Path(path)
    try:
        contents = _read_contents(path)
        faults = tuple(run_file_faults(contents))
        if faults:
            return None, tuple(fault.with_location(file=str(path)) for fault in faults)
        order = None if contents.loads is None else tuple(contents.loads.names.index(name) for name in COMPONENTS)
        run = run_from_contents(contents, Hdf5Source(path, order), path)
        faults = tuple(load_sample_faults(run))
        return replace(run, digest=run_digest(run)), tuple(fault.with_location(file=str(path)) for fault in faults)
    except UserError as error:
        return None, (error.with_location(file=str(path)),)


def open_runs(
    paths: Iterable[Path], geometry: Geometry, skip_bad: bool = False
) -> tuple[tuple[Run, ...], dict[Path, str]]:
    """Open the runs of one campaign, and say which were skipped and why (path -> message).

    UserError where a run cannot be read, belongs to another rig, has none of the geometry's channels, or has the name
    of another run. With `skip_bad` such a run is skipped, but two different runs of one name remain an error, and so
    does a list of which nothing is left.
    """
    runs: dict[str, Run] = {}
    skipped: dict[Path, str] = {}
    for path in map(Path, paths):
        try:
            run = _matching_run(path, geometry)
        except UserError as error:
            if not skip_bad:
                raise
            skipped[path] = str(error)
            continue
        first = runs.setdefault(run.name, run)
        if first is not run:
            if not skip_bad or run.digest != first.digest:
                raise _duplicate_run_error(run, first)
            skipped[path] = str(_duplicate_run_error(run, first))
    if skipped and not runs:
        raise UserError("no run is left: all were skipped", remedy=f"First reason: {next(iter(skipped.values()))}")
    return tuple(runs.values()), skipped


def _matching_run(path: Path, geometry: Geometry) -> Run:
    run = open_run(path)
    mismatch = next(geometry_mismatches(run, geometry), None)
    if mismatch:
        raise mismatch
    return run


def geometry_mismatches(run: Run, geometry: Geometry) -> Iterator[UserError]:
    """Why a run does not belong to this geometry."""
    file = str(run.path or run.name)
    if run.rig != geometry.rig:
        fault = f"is of rig `{run.rig}`, but the geometry `{geometry.name}` is of rig `{geometry.rig}`"
        yield UserError(fault, file, "rig", "Give the geometry of that rig, or runs of this one")
    if not set(run.channel_names) & set(geometry.channel_names):
        fault = f"has none of the channels that the geometry `{geometry.name}` declares"
        yield UserError(fault, file, "channels", f"It should have {', '.join(geometry.channel_names)}")


def _duplicate_run_error(run: Run, first: Run) -> UserError:
    if run.digest == first.digest:
        return UserError(f"is a second copy of {first.path}", str(run.path), "run", "Give it once")
    remedy = f"Rename one of them (attribute `run`, now `{run.name}`)"
    return UserError(f"has the same run name as {first.path}", str(run.path), "run", remedy)


# ---- writing ---------------------------------------------------------------------------------------------------------


def write_run(path: Path, run: Run) -> None:
    """Write a run file, whole or not at all; samples as float32 where that loses nothing, else float64."""
    with atomic_write(Path(path)) as part, h5py.File(part, "w") as file:
        for name, value in _attributes(run).items():
            file.attrs[name] = value
        exact = all(_fits_float32(block.channels) and _fits_float32(block.loads) for block in run.blocks())
        kind = np.float32 if exact else np.float64
        channels = _create_dataset(file, "channels", run.samples, run.channel_names, kind)
        channels.attrs["unit"] = "V"
        loads = _create_dataset(file, "loads", run.samples, COMPONENTS, kind) if run.has_loads else None
        if loads is not None:
            loads.attrs.create("units", UNITS, dtype=h5py.string_dtype())
        for block in run.blocks():
            channels[block.start : block.start + len(block.channels)] = block.channels
            if loads is not None:
                loads[block.start : block.start + len(block.channels)] = block.loads
        if run.pulse_times is not None:
            file["rotor/pulse_times"] = run.pulse_times
        if run.attitude is not None:
            angles = _create_dataset(file, "attitude", run.samples, ANGLES, np.float64)
            angles.attrs["unit"] = "deg"
            angles[:] = run.attitude


def _attributes(run: Run) -> dict[str, Any]:
    several = len(run.excited) > 1
    excited = np.array(run.excited, h5py.string_dtype()) if several else "".join(run.excited)
    values = {
        "format": RUN_FORMAT,
        "kind": run.kind,
        "run": run.name,
        "rig": run.rig,
        "sample_rate": run.sample_rate,
        "rotor_speed": run.rotor_speed if run.kind != "static" else None,
        "excited": excited if run.excited else None,
        "excitation": run.excitation,
        "level": (np.array(run.level) if several else run.level[0]) if run.level else None,
        "period": run.period,
        "trim": run.trim,
        "recorded": run.recorded,
        "note": run.note,
    }
    return {name: value for name, value in values.items() if value is not None}


def _fits_float32(samples: Array | None) -> bool:
    return samples is None or np.array_equal(samples, samples.astype(np.float32), equal_nan=True)


def _create_dataset(file: h5py.File, name: str, rows: int, columns: tuple[str, ...], kind: type) -> Any:
    chunk = (min(rows, CHUNK_ROWS), len(columns))
    dataset = file.create_dataset(
        name, (rows, len(columns)), kind, chunks=chunk, compression="gzip", shuffle=True, fletcher32=True
    )
    dataset.attrs.create("names", columns, dtype=h5py.string_dtype())
    return dataset


# ---- reading ---------------------------------------------------------------------------------------------------------


@contextmanager
def report_damage(path: Path) -> Iterator[None]:
    """Whatever a truncated or damaged HDF5 file makes h5py say, as one UserError."""
    try:
        yield
    except (OSError, RuntimeError, LookupError, ValueError, TypeError, AttributeError, MemoryError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        fault = f"cannot be read, it is truncated or damaged ({reason})"
        raise UserError(fault, str(path), remedy="Copy it again from where it was recorded") from error


def _read_contents(path: Path) -> RunFileContents:
    """Everything in a run file but the samples. UserError where it is no run file."""
    require_file(path)
    if not is_hdf5(path):
        raise _not_a_run_error(path)
    with report_damage(path), h5py.File(path, "r") as file:
        attributes = _read_attributes(file, RUN_ATTRIBUTES)
        if attributes.get("format") != RUN_FORMAT:
            raise _not_a_run_error(path)
        pulses, attitude = file.get("rotor/pulse_times"), _read_table(file, "attitude", "unit")
        return RunFileContents(
            attributes,
            channels=_read_table(file, "channels", "unit"),
            loads=_read_table(file, "loads", "units"),
            pulse_times=None if pulses is None else np.asarray(pulses[()]),
            attitude=attitude,
            angles=None if attitude is None else np.asarray(file["attitude"][()]),
        )


def _not_a_run_error(path: Path) -> UserError:
    return UserError(
        f"is {describe_file(path)}, where a run file (`{RUN_FORMAT}`) was expected", remedy="Give a run file"
    )


def _read_table(file: h5py.File, name: str, units: str) -> DatasetLayout | None:
    dataset = file.get(name)
    if dataset is None:
        return None
    if not isinstance(dataset, h5py.Dataset):
        raise UserError("is not a dataset", place=name, remedy="Write it as a dataset")
    found = _read_attributes(dataset, ("names", units))
    shape = tuple(dataset.shape or ())
    names, unit = _as_texts(found.get("names")), _as_texts(found.get(units))
    return DatasetLayout(shape, dataset.dtype.kind, names, unit, _is_complete(dataset, shape))


def _is_complete(dataset: h5py.Dataset, shape: tuple[int, ...]) -> bool:
    """Whether all samples were written; HDF5 reads those that were not as zeros."""
    if dataset.chunks is None:
        stored, needed = dataset.id.get_storage_size(), math.prod(shape) * dataset.dtype.itemsize
    else:
        chunks = (-(-size // chunk) for size, chunk in zip(shape, dataset.chunks, strict=True))
        stored, needed = dataset.id.get_num_chunks(), math.prod(chunks)
    return bool(stored >= needed)


def _read_attributes(item: h5py.File | h5py.Dataset, names: Iterable[str]) -> dict[str, Any]:
    """Those of the named attributes that are there; ValueError where one is longer than any can be (a damaged file)."""
    found = {}
    for name in names:
        if name in item.attrs:
            if math.prod(item.attrs.get_id(name).shape or ()) > MOST_ATTRIBUTE_ENTRIES:
                raise ValueError(f"attribute {name} claims too many entries")
            found[name] = _native_value(item.attrs[name])
    return found


def _native_value(value: Any) -> Any:
    """An attribute as str (what is not UTF-8 replaced), number, or list of several; one entry counts as a scalar."""
    if isinstance(value, bytes | str):
        return attribute_text(value)
    if isinstance(value, np.ndarray):
        entries = [_native_value(item) for item in value.ravel().tolist()]
        return entries[0] if len(entries) == 1 else entries
    return value.item() if isinstance(value, np.generic) else value


def _as_texts(value: Any) -> tuple[str, ...]:
    items = [value] if isinstance(value, str) else value
    return tuple(str(item) for item in items) if isinstance(items, list | tuple) else ()
