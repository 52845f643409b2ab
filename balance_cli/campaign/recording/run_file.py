"""Run files (HDF5, `balance-run/1`): the only reader and writer of raw data."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from balance_cli.campaign.recording.additions_file import read_additions, write_additions
from balance_cli.campaign.recording.gaps import bridge_gaps
from balance_cli.campaign.recording.hdf5_source import Hdf5Source
from balance_cli.campaign.recording.point_loads import load_point_faults, with_hub_loads, without_point_loads
from balance_cli.campaign.recording.reading_units import (
    reading_conversion,
    reading_unit_mismatches,
    reading_units,
    unit_attribute,
)
from balance_cli.campaign.recording.run import (
    MOST_HELD_TOGETHER,
    Array,
    Run,
    SampleBlock,
    have_same_samples,
    held_bytes,
    hold_samples,
    run_digest,
)
from balance_cli.campaign.recording.run_checks import load_sample_faults, run_file_faults
from balance_cli.campaign.recording.run_contents import read_contents, report_damage
from balance_cli.campaign.recording.run_schema import DatasetLayout, RunFileContents, as_list, run_from_contents
from balance_cli.campaign.recording.stored_runs import read_urls
from balance_cli.campaign.rig.attitude import ANGLES
from balance_cli.campaign.rig.components import COMPONENTS, UNITS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.atomic import atomic_write
from balance_cli.io.errors import UserError
from balance_cli.io.formats import RUN_FORMAT
from balance_cli.io.hdf5_output import Hdf5Output
from balance_cli.io.reader_process import read_in_child

CHUNK_ROWS = 4096
"""Samples in a chunk of a dataset: 5 s at 800 Hz, so that a short excerpt needs few chunks."""


def open_run(path: Path, hold: bool = False) -> Run:
    """Open a run file.

    Its samples are read once for their digest, then on demand; with `hold` they stay in memory, if they are not too
    many. Raises UserError for its first fault.
    """
    run, faults = read_run(path, hold)
    if run is None or faults:
        raise faults[0]
    return run


def read_run(path: Path, hold: bool = False) -> tuple[Run | None, tuple[UserError, ...]]:
    """Return the run in a file, None where it cannot be read, and all faults of the file."""
    path = Path(path)
    try:
        run, faults = _read_whole_run(path, hold)
        if run is not None:
            run = bridge_gaps(run)
            faults = tuple(load_sample_faults(run))
    except UserError as error:
        run, faults = None, (error,)
    return run, tuple(fault.with_location(file=str(path)) for fault in faults)


@read_in_child
def _read_whole_run(path: Path, hold: bool) -> tuple[Run | None, tuple[UserError, ...]]:
    run, faults = _read_header(path)
    if run is None:
        return None, faults
    with report_damage(path):
        run = replace(run, additions=read_additions(path, run.samples))
    run = hold_samples(run) if hold else run
    return replace(run, digest=run_digest(run)), ()


def _read_header(path: Path) -> tuple[Run | None, tuple[UserError, ...]]:
    """The run in a file without its additions and its digest, and the faults that show without its samples."""
    contents = read_contents(path)
    faults = tuple(run_file_faults(contents))
    if faults:
        return None, faults
    order = None if contents.loads is None else tuple(contents.loads.names.index(name) for name in COMPONENTS)
    run = run_from_contents(contents, Hdf5Source(path, order, reading_conversion(contents)), path)
    return replace(run, reading_units=reading_units(contents)), ()


@read_in_child
def _read_header_alone(path: Path) -> tuple[Run | None, tuple[UserError, ...]]:
    return _read_header(path)


def stated_reading_units(path: Path) -> dict[str, str]:
    """Base units of the channels of a file that are not read in V; none where it cannot be read."""
    try:
        run, _ = _read_header_alone(path)
    except UserError:
        return {}
    return {} if run is None else run.reading_units


@read_urls()
def run_header(path: Path, geometry: Geometry | None) -> Run:
    """Return a run by what its file holds beside the samples, without digest and additions.

    Raises UserError for the first fault that shows so, such as another rig than that of a geometry.
    """
    try:
        run, faults = _read_header_alone(path)
    except UserError as error:
        raise error.with_location(file=str(path)) from None
    if run is None:
        raise faults[0].with_location(file=str(path))
    _require_match(run, geometry)
    return run


def open_runs(
    paths: Iterable[Path], geometry: Geometry, skip_bad: bool = False
) -> tuple[tuple[Run, ...], dict[Path, str]]:
    """Open the runs of one campaign, and return them with the files that were skipped (path -> reason).

    The samples of the first runs stay in memory: a command reads them again for its cross-checks, and for its results.

    Raises UserError where a run cannot be read, belongs to another rig, has none of the channels of the geometry, or
    has the name of another run. With `skip_bad` such a run is skipped; two different runs of one name remain an error,
    and so does a list of which no run is left.
    """
    runs: dict[str, Run] = {}
    skipped: dict[Path, str] = {}
    held = 0
    for path in map(Path, paths):
        try:
            run = open_matching_run(path, geometry, hold=held < MOST_HELD_TOGETHER)
        except UserError as error:
            if not skip_bad:
                raise
            skipped[path] = str(error)
            continue
        held += held_bytes(run)
        if (first := runs.setdefault(run.name, run)) is not run:
            if not skip_bad or run.digest != first.digest:
                raise duplicate_run_error(run, first)
            skipped[path] = str(duplicate_run_error(run, first))
    if skipped and not runs:
        raise UserError("all runs were skipped", remedy=f"First reason: {next(iter(skipped.values()))}")
    return tuple(runs.values()), skipped


@read_urls(hold=True)
def open_matching_run(path: Path, geometry: Geometry, hold: bool = False) -> Run:
    """Open a run file of this rig, with the loads at its hub.

    Raises UserError where it cannot be read, or is of another rig.
    """
    run = open_run(path, hold)
    _require_match(run, geometry)
    return with_hub_loads(run, geometry)


def _require_match(run: Run, geometry: Geometry | None) -> None:
    mismatch = geometry and next(geometry_mismatches(run, geometry), None)
    if mismatch:
        raise mismatch


def geometry_mismatches(run: Run, geometry: Geometry) -> Iterator[UserError]:
    """Yield the reasons why a run does not belong to this geometry."""
    file = run.file
    if run.rig != geometry.rig:
        fault = f"is of rig `{run.rig}`, but the geometry `{geometry.name}` is of rig `{geometry.rig}`"
        yield UserError(fault, file, "rig", "Give the geometry of that rig, or runs of this one")
    if not set(run.channel_names) & set(geometry.channel_names):
        fault = f"has none of the channels that the geometry `{geometry.name}` declares"
        yield UserError(fault, file, "channels", f"It should have {', '.join(geometry.channel_names)}")
    yield from reading_unit_mismatches(run, geometry)
    yield from load_point_faults(run, geometry)


def duplicate_run_error(run: Run, first: Run) -> UserError:
    """Return the error of a run that has the name of another one."""
    if run.digest == first.digest:
        return UserError(f"is a second copy of {first.path}", str(run.path), "run", "Give it once")
    remedy = f"Rename one of them (attribute `run`, now `{run.name}`)"
    return UserError(f"has the same run name as {first.path}", str(run.path), "run", remedy)


def require_disjoint(runs: Iterable[Run], used: Iterable[Run]) -> None:
    """Raise UserError for a run that is also in the list `used`, under its own name or another."""
    used = tuple(used)
    for run in runs:
        for other in used:
            if run.name == other.name:
                raise UserError(f"run `{run.name}` is in both lists", str(run.path), remedy="Give it in one list only")
            if have_same_samples(run, other):
                fault = f"has the samples of run `{other.name}` ({other.path}), which is in the other list"
                raise UserError(fault, str(run.path), "channels", "Give the recording in one list only")


# ---- writing ---------------------------------------------------------------------------------------------------------


def write_run(path: Path, run: Run, blocks: Iterable[SampleBlock] | None = None) -> None:
    """Write a run file, whole or not at all.

    Samples are stored as float32 where that loses nothing; those of `blocks`, which are read only once, as float64.
    """
    run = without_point_loads(run) if blocks is None else run
    with atomic_write(Path(path)) as part, Hdf5Output(part) as output:
        file = output.file
        for name, value in _attributes(run).items():
            file.attrs[name] = value
        exact = blocks is None and all(
            _fits_float32(block.channels) and _fits_float32(block.loads) for block in run.blocks()
        )
        kind = np.float32 if exact else np.float64
        channels = _create_dataset(file, "channels", run.samples, run.channel_names, kind)
        channels.attrs.create("unit", unit_attribute(run), dtype=h5py.string_dtype())
        loads = _create_dataset(file, "loads", run.samples, COMPONENTS, kind) if run.has_loads else None
        if loads is not None:
            loads.attrs.create("units", UNITS, dtype=h5py.string_dtype())
        for block in run.blocks() if blocks is None else blocks:
            channels[block.start : block.start + len(block.channels)] = block.channels
            if loads is not None:
                loads[block.start : block.start + len(block.channels)] = block.loads
            output.check()
        if run.pulse_times is not None:
            file["rotor/pulse_times"] = run.pulse_times
        if run.attitude is not None:
            angles = _create_dataset(file, "attitude", run.samples, ANGLES, np.float64)
            angles.attrs["unit"] = "deg"
            angles[:] = run.attitude
        if run.additions is not None:
            write_additions(file, run.additions, run.samples)
        for name, labels in (("series", run.series_labels), ("point", run.point_kinds)):
            if labels is not None:
                file.create_dataset(name, data=np.array(labels, h5py.string_dtype()))


def contents_of_run(run: Run) -> RunFileContents:
    """What the file of a run holds beside its samples, for the checks of run files."""
    attributes = {
        name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in _attributes(run).items()
    }
    pulses, angles = run.pulse_times, run.attitude
    return RunFileContents(
        attributes,
        channels=DatasetLayout(
            (run.samples, len(run.channel_names)), "f", run.channel_names, tuple(as_list(unit_attribute(run)))
        ),
        loads=DatasetLayout((run.samples, len(COMPONENTS)), "f", COMPONENTS, UNITS) if run.has_loads else None,
        pulses=None if pulses is None else DatasetLayout(pulses.shape, "f", (), ()),
        pulse_times=pulses,
        attitude=None if angles is None else DatasetLayout(angles.shape, "f", ANGLES, ("deg",)),
        angles=angles,
        has_load_points=run.additions is not None and run.additions.load_points is not None,
    )


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
    return run.conditions | {name: value for name, value in values.items() if value is not None}


def _fits_float32(samples: Array | None) -> bool:
    return samples is None or np.array_equal(samples, samples.astype(np.float32), equal_nan=True)


def _create_dataset(file: h5py.File, name: str, rows: int, columns: tuple[str, ...], kind: type) -> Any:
    chunk = (min(rows, CHUNK_ROWS), len(columns))
    dataset = file.create_dataset(
        name, (rows, len(columns)), kind, chunks=chunk, compression="gzip", shuffle=True, fletcher32=True
    )
    dataset.attrs.create("names", columns, dtype=h5py.string_dtype())
    return dataset
