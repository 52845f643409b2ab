"""The optional parts of a run file: read with their checks, and written."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from balance_cli.campaign.recording.additions import (
    BLOCK,
    FORCE,
    POSITION,
    TEMPERATURE,
    Array,
    LoadPoints,
    RunAdditions,
)
from balance_cli.campaign.recording.run import LARGEST_MAGNITUDE
from balance_cli.io.errors import UserError
from balance_cli.io.hdf5_links import refuse_other_files
from balance_cli.io.sniff import attribute_text

AZIMUTH_ERROR = "azimuth_error_deg"
MOST_POINTS = 500
DIRECTION = "load_points/direction"
WIDE_RANGE = (-273.15, 3000.0)
"""[degC] of a temperature; one that was given in K or degF of a hot machine still passes, one in counts does not."""


@dataclass(frozen=True)
class Hdf5Additions:
    """Datasets in a run file, which is opened for each read."""

    path: Path

    def read(self, dataset: str, start: int, stop: int) -> Array:
        """Rows start to stop."""
        with h5py.File(self.path, "r") as file:
            return np.asarray(file[dataset][start:stop], np.float64)


def read_additions(path: Path, rows: int) -> RunAdditions | None:
    """The optional parts of a run file whose channels have `rows` rows; None where it has none.

    Raises UserError, without the file, for the first fault.
    """
    with h5py.File(path, "r") as file:
        error = file.attrs.get(AZIMUTH_ERROR)
        additions = RunAdditions(
            load_points=_read_points(file, rows) if "load_points" in file else None,
            temperature_names=() if _is_empty(file, TEMPERATURE) else _read_temperature_names(file, rows),
            further_pulse_times=tuple(_read_further_pulses(file)),
            azimuth_error_deg=None if error is None else _azimuth_error(error),
            source=Hdf5Additions(path),
        )
    _check_samples(additions, rows)
    return None if additions.is_empty else additions


def _azimuth_error(value: Any) -> float:
    if not np.isscalar(value) or not np.isreal(value) or not 0.0 <= float(np.real(value)) <= 360.0:
        raise UserError(f"is {value!r}", place=f"attribute {AZIMUTH_ERROR}", remedy="It should be degrees, or absent")
    return float(np.real(value))


def _is_empty(file: h5py.File, name: str) -> bool:
    """Whether there is nothing in a dataset, or no dataset."""
    refuse_other_files(file, name)
    dataset = file.get(name)
    return dataset is None or (isinstance(dataset, h5py.Dataset) and not dataset.size)


def _numbers(file: h5py.File, name: str) -> Any:
    """A dataset of real numbers."""
    refuse_other_files(file, name)
    dataset = file.get(name)
    if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind not in "iuf":
        raise UserError("is missing, or no dataset of real numbers", place=name, remedy="Add it, or remove its group")
    return dataset


def _read_points(file: h5py.File, rows: int) -> LoadPoints:
    force = _numbers(file, FORCE)
    count = force.shape[1] if len(force.shape) == 2 else 0
    if force.shape != (rows, count) or not 0 < count <= MOST_POINTS:
        fault = f"has the shape {force.shape}"
        raise UserError(fault, place=FORCE, remedy=f"It should be {rows} rows, as the channels, by points")
    names = _names(force, count)
    if names and DIRECTION not in file and POSITION not in file:
        return LoadPoints(names, np.full((count, 3), np.nan), np.full((count, 3), np.nan))
    direction, position = _numbers(file, DIRECTION), _numbers(file, POSITION)
    if direction.shape != (count, 3):
        raise UserError(f"has the shape {direction.shape}", place=DIRECTION, remedy=f"It should be ({count}, 3)")
    if position.shape not in ((count, 3), (rows, count, 3)):
        remedy = f"It should be ({count}, 3), or ({rows}, {count}, 3) for points that move"
        raise UserError(f"has the shape {position.shape}", place=POSITION, remedy=remedy)
    directions = np.asarray(direction[()], float)
    if not np.all(np.isfinite(directions)) or np.any(np.linalg.norm(directions, axis=1) == 0.0):
        raise UserError("a direction has no length", place=DIRECTION, remedy="Give vectors in rig axes")
    fixed = np.asarray(position[()], float) if len(position.shape) == 2 else None
    if fixed is not None and not np.all(np.abs(fixed) <= LARGEST_MAGNITUDE):
        raise UserError("a position is not a finite number", place=POSITION, remedy="Give positions in m")
    return LoadPoints(names or tuple(f"point {k + 1}" for k in range(count)), directions, fixed)


def _names(dataset: Any, count: int) -> tuple[str, ...]:
    """The attribute `names`; empty where there is none."""
    if "names" not in dataset.attrs:
        return ()
    names = tuple(str(attribute_text(name)) for name in np.atleast_1d(dataset.attrs["names"]).tolist())
    if len(names) != count or len(set(names)) < count:
        place = f"{dataset.name.lstrip('/')}, attribute names"
        raise UserError(f"{len(set(names))} names for {count} columns", place=place, remedy="Names must differ")
    return names


def _read_temperature_names(file: h5py.File, rows: int) -> tuple[str, ...]:
    dataset = _numbers(file, TEMPERATURE)
    if len(dataset.shape) != 2 or dataset.shape[0] != rows or not dataset.shape[1]:
        remedy = f"It should be {rows} rows by sensors, such as ({rows}, 1)"
        raise UserError(f"has the shape {dataset.shape}", place=TEMPERATURE, remedy=remedy)
    unit = attribute_text(dataset.attrs.get("unit"))
    if unit != "degC":
        remedy = "It should be `degC`"
        raise UserError(f"its unit is {unit or 'missing'}", place=f"{TEMPERATURE}, attribute unit", remedy=remedy)
    names = _names(dataset, dataset.shape[1])
    if not names:
        raise UserError("the names are missing", place=f"{TEMPERATURE}, attribute names", remedy="Name each column")
    return names


def _read_further_pulses(file: h5py.File) -> Iterator[Array]:
    """Pulse times of `rotor2`, `rotor3` and so on."""
    for number in itertools.count(2):
        name = f"rotor{number}/pulse_times"
        if name not in file:
            return
        times = np.asarray(_numbers(file, name)[()], float)
        if times.ndim != 1 or not np.all(np.abs(times) <= LARGEST_MAGNITUDE) or np.any(np.diff(times) <= 0.0):
            fault = "is not a list of finite times that increase"
            raise UserError(fault, place=name, remedy="Give times in s from the first sample")
        yield times


def _check_samples(additions: RunAdditions, rows: int) -> None:
    """Raise UserError where a force, position or temperature is not finite, or not plausible."""
    for dataset in additions.sampled_datasets:
        low, high = WIDE_RANGE if dataset == TEMPERATURE else (-LARGEST_MAGNITUDE, LARGEST_MAGNITUDE)
        for start in range(0, rows, BLOCK):
            values = additions.read(dataset, start, min(start + BLOCK, rows))
            bad = ~((values >= low) & (values <= high))
            if dataset == TEMPERATURE:
                bad &= ~np.isnan(values)  # a sensor that is not connected
            if np.any(bad):
                row = start + int(np.argwhere(bad)[0][0]) + 1
                fault = f"sample {row} is not finite, or beyond {low:g} to {high:g}"
                raise UserError(fault, place=dataset, remedy="Correct it, or remove the dataset")


def write_additions(file: Any, additions: RunAdditions, rows: int) -> None:
    """Write the optional parts into an open run file."""
    if additions.azimuth_error_deg is not None:
        file.attrs[AZIMUTH_ERROR] = additions.azimuth_error_deg
    for number, times in enumerate(additions.further_pulse_times, 2):
        file[f"rotor{number}/pulse_times"] = times
    points = additions.load_points
    if points is not None and not points.are_named_only:
        file[DIRECTION] = points.direction
        if points.position is not None:
            file[POSITION] = points.position
    for name in additions.sampled_datasets:
        _write_sampled(file, name, additions, rows)
    if points is not None:
        file[FORCE].attrs.create("names", points.names, dtype=h5py.string_dtype())
        file[FORCE].attrs["unit"] = "N"
        if POSITION in file:
            file[POSITION].attrs["unit"] = "m"
    if additions.temperature_names:
        file[TEMPERATURE].attrs.create("names", additions.temperature_names, dtype=h5py.string_dtype())
        file[TEMPERATURE].attrs["unit"] = "degC"


def _write_sampled(file: Any, name: str, additions: RunAdditions, rows: int) -> None:
    first = additions.read(name, 0, 1)
    chunk = (min(rows, BLOCK // 16), *first.shape[1:])
    dataset = file.create_dataset(
        name, (rows, *first.shape[1:]), np.float64, chunks=chunk, compression="gzip", shuffle=True, fletcher32=True
    )
    for start in range(0, rows, BLOCK):
        stop = min(start + BLOCK, rows)
        dataset[start:stop] = additions.read(name, start, stop)
