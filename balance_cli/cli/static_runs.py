"""Run files and point tables as inputs of one command, and the options that say how tables are read."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from balance_cli.cli.common import Session
from balance_cli.cli.options import InputFile, NumberRange
from balance_cli.io.errors import UserError

if TYPE_CHECKING:
    from balance_cli.campaign.recording.load_table import LoadTable, TableReading
    from balance_cli.campaign.recording.run import Run
    from balance_cli.campaign.rig.geometry import Geometry

F = TypeVar("F", bound=Callable[..., Any])

COORDINATE = NumberRange(-1e3, 1e3)
"""Distance from the origin of the rig axes [m] along one of them: no rig is larger than a kilometer."""

units_option: Callable[[F], F] = click.option(
    "--units",
    "units",
    metavar="UNIT,...",
    help="Units of the columns of tables that state none, one for each quantity: `N,N m,mV/V`.",
)
moment_center_option: Callable[[F], F] = click.option(
    "--moment-center",
    "moment_center",
    type=(COORDINATE, COORDINATE, COORDINATE),
    metavar="X Y Z",
    help="Point [m, rig axes] about which the moments of the tables are taken; default: the hub.",
)


def table_reading(units: str | None, moment_center: tuple[float, float, float] | None) -> TableReading:
    """How tables are read, from the options; raises UserError for an unknown unit."""
    from balance_cli.campaign.recording.load_table import TableReading
    from balance_cli.io.units import parse_unit

    try:
        parsed = tuple(parse_unit(text) for text in (units or "").split(",") if text.strip())
    except UserError as error:
        raise error.with_location("--units") from None
    return TableReading(parsed, moment_center)


optional_geometry_option: Callable[[F], F] = click.option(
    "-g",
    "--geometry",
    "geometry",
    type=InputFile(),
    metavar="GEOMETRY",
    help="Geometry of the rig. Point tables of hub loads, with the units of their readings in the head, need none, "
    "nor do linear matrices.",
)


def rig_of_inputs(
    session: Session, geometry: Path | None, paths: Iterable[Path], reading: TableReading, matrix: Path | None
) -> Geometry:
    """The geometry that is given, with units that the files state and it does not; without one that of the first table.

    Without a table it is that of the linear `matrix`, where one is given.

    Raises UserError without a geometry where there is no table, or a run file that needs one.
    """
    from balance_cli.campaign.recording.load_table import is_point_table
    from balance_cli.campaign.recording.reading_units import channels_of_free_unit, declare_reading_units
    from balance_cli.campaign.recording.run_file import stated_reading_units
    from balance_cli.campaign.recording.table_geometry import declare_table_units, geometry_of_table
    from balance_cli.campaign.rig.load_components import load_components

    paths = tuple(paths)
    tables = [path for path in paths if is_point_table(path)]
    if geometry is not None:
        rig = declare_table_units(session.geometry(geometry, mechanics=False), tables, reading)
        files = [path for path in paths if path not in tables] if channels_of_free_unit(rig) else []
        return declare_reading_units(rig, map(stated_reading_units, files))
    if not paths and matrix is not None:
        return _rig_of_matrix(session, matrix)
    if not tables or len(tables) < len(paths):
        fault = "no geometry is given, and only point tables do without one"
        raise UserError(fault, "-g", remedy="Give the geometry of the rig with -g GEOMETRY")
    rig = geometry_of_table(tables[0])
    session.echo(
        f"without a geometry: {', '.join(rig.channel_names)} of {tables[0].name} are the channels, "
        f"{', '.join(load_components(rig).names)} the loads"
    )
    return rig


def _rig_of_matrix(session: Session, matrix: Path) -> Geometry:
    from balance_cli.calibration.matrix_geometry import geometry_of_matrix

    rig = geometry_of_matrix(matrix)
    session.echo(f"without a geometry: {', '.join(rig.channel_names)} are the channels of {matrix.name}")
    return rig


def open_static_runs(
    session: Session,
    paths: Iterable[Path],
    geometry: Geometry,
    reading: TableReading,
    skip_bad: bool = False,
    role: str = "run",
    disjoint_from: Iterable[Run] = (),
) -> tuple[Run, ...]:
    """Open run files and point tables of this rig and record them as inputs, as `Session.runs` does."""
    from balance_cli.campaign.recording.gaps import bridge_gaps, describe_gaps, gap_summary
    from balance_cli.campaign.recording.load_table import is_point_table, runs_of_table

    reading = replace(reading, allow_missing=True)
    paths, used = tuple(paths), tuple(disjoint_from)
    files = [path for path in paths if not is_point_table(path)]
    runs = list(session.runs(files, geometry, skip_bad, role, used)) if files else []
    for table in _open_tables(session, [path for path in paths if path not in files], geometry, reading, role):
        for run in runs_of_table(table, geometry):
            if run.name in {other.name for other in (*used, *runs)}:
                fault = f"has the run `{run.name}`, which another file has too"
                raise UserError(fault, str(table.path), remedy="Rename one of the two, and give each file once")
            complete = bridge_gaps(run)
            session.record_gaps(run.name, gap_summary(complete), describe_gaps(complete))
            runs.append(complete)
    return tuple(runs)


def _open_tables(
    session: Session, paths: Iterable[Path], geometry: Geometry, reading: TableReading, role: str
) -> list[LoadTable]:
    """Read point tables; those of one load each are one table."""
    from balance_cli.campaign.recording.single_load_tables import joined_single_loads

    tables: list[LoadTable] = []
    for path in paths:
        known = {table.unused for table in tables}
        tables.append(open_table(session, path, geometry, reading, role, known))
    joined = joined_single_loads(tables)
    if joined is None:
        return tables
    names = f"{tables[0].path.name} to {tables[-1].path.name}"
    session.warn(f"{len(tables)} tables of one load each, {names}, are one load series with one zero, in this order")
    return [joined]


def open_table(
    session: Session,
    path: Path,
    geometry: Geometry,
    reading: TableReading,
    role: str,
    known_unused: Container[tuple[str, ...]] = (),
) -> LoadTable:
    """Read a point table, record it as an input, and warn about columns that are not used, but for known ones."""
    from balance_cli.campaign.recording.load_table import read_load_table

    table = read_load_table(path, geometry, reading)
    if table.other_rows:
        session.warn(f"{path}: no load points, left out: {table.other_rows}")
    for note in table.notes:
        session.warn(f"{path}: {note}")
    if table.unused and table.unused not in known_unused:
        session.warn(f"{path}: columns not used: {', '.join(table.unused)}")
    session.record_input(path.name, role, table.digest)
    return table
