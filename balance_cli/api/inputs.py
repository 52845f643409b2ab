"""Runs and geometries, given as paths or as objects."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from balance_cli.campaign.recording.point_loads import with_hub_loads
from balance_cli.campaign.recording.run import Run
from balance_cli.campaign.recording.run_file import geometry_mismatches, open_run
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_file import load_geometry
from balance_cli.io.errors import UserError

PathLike = str | os.PathLike[str]
RunLike = Run | PathLike
GeometryLike = Geometry | PathLike

TABLE_SUFFIXES = (".csv", ".txt", ".tsv")
"""Names of point tables; the commands tell them by their content."""


def read_run(path: PathLike) -> Run:
    """Open a run file (HDF5, `balance-run/1`); its samples are read when they are needed.

    Raises UserError for the first fault of the file.

    >>> import balance_cli as bal
    >>> run = bal.read_run("sample_data/check-1.h5")
    >>> run
    Check run check-1 of rig RTS-6: 15 channels, 16000 samples at 800 Hz
    >>> run.read(0, 100).channels.shape
    (100, 15)
    """
    return open_run(Path(path))


def read_geometry(path: PathLike) -> Geometry:
    """Read the geometry of a rig (YAML, `balance-geometry/1`).

    Raises UserError for the first fault of the file.

    >>> import balance_cli as bal
    >>> geometry = bal.read_geometry("configs/rts-6.yaml")
    >>> geometry
    Geometry rts-1 of rig RTS-6: 7 cells, 15 channels
    >>> geometry.cell_names
    ('x', 'y1', 'y2', 'z1', 'z2', 'z3', 'z4')
    """
    return load_geometry(Path(path))


def to_geometry(geometry: GeometryLike) -> Geometry:
    """The geometry itself, or the one in the file."""
    return geometry if isinstance(geometry, Geometry) else read_geometry(geometry)


def to_runs(runs: RunLike | Iterable[RunLike], geometry: Geometry) -> tuple[Run, ...]:
    """The runs, opened where paths are given; a point table may hold several.

    Raises UserError where a file cannot be read, a run belongs to another rig, or two runs have one name.
    """
    items = [runs] if isinstance(runs, Run | str | os.PathLike) else list(runs)
    for item in items:
        if not isinstance(item, Run | str | os.PathLike):
            raise TypeError(f"`runs` must be runs or paths, not {type(item).__name__}")
    opened: dict[str, Run] = {}
    for run in _open([item if isinstance(item, Run) else Path(item) for item in items], geometry):
        for mismatch in geometry_mismatches(run, geometry):
            raise mismatch
        if run.name in opened:
            raise UserError(f"two runs are named `{run.name}`", run.file, "run", "Give each run once")
        opened[run.name] = with_hub_loads(run, geometry)
    return tuple(opened.values())


def _open(items: Sequence[Run | Path], geometry: Geometry) -> Iterator[Run]:
    """The runs, those of files, and the static ones of point tables, which their names tell, at the end."""
    tables = [item for item in items if isinstance(item, Path) and item.suffix.lower() in TABLE_SUFFIXES]
    for item in items:
        if item not in tables:
            yield item if isinstance(item, Run) else read_run(item)
    if tables:
        from balance_cli.campaign.recording.load_table import read_load_table, runs_of_table
        from balance_cli.campaign.recording.single_load_tables import joined_single_loads

        read = [read_load_table(path, geometry) for path in tables]
        joined = joined_single_loads(read)
        for table in read if joined is None else [joined]:
            yield from runs_of_table(table, geometry)


def require_band(band: tuple[float, float] | None) -> None:
    """Raise UserError unless a band [Hz] begins at a finite frequency and rises. None: no band is given."""
    if band is not None and not (math.isfinite(band[0]) and band[0] < band[1]):
        fault = f"no line lies between {band[0]:g} and {band[1]:g} Hz"
        raise UserError(fault, "band", remedy="Give the lowest frequency first, then the highest")


def require_disjoint(runs: Iterable[Run], hold_out: Iterable[Run]) -> None:
    """Raise UserError where a run is both fitted and held out."""
    fitted = {run.name for run in runs}
    for run in hold_out:
        if run.name in fitted:
            raise UserError(f"run `{run.name}` is in both lists", str(run.path or ""), remedy="Give it in one of them")
