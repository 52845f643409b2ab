"""Run files and point tables as inputs of one command, and the options that say how tables are read."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from balance_cli.cli.common import Session
from balance_cli.io.errors import UserError

if TYPE_CHECKING:
    from balance_cli.campaign.recording.load_table import LoadTable, TableReading
    from balance_cli.campaign.recording.run import Run
    from balance_cli.campaign.rig.geometry import Geometry

F = TypeVar("F", bound=Callable[..., Any])

units_option: Callable[[F], F] = click.option(
    "--units",
    "units",
    metavar="UNIT,...",
    help="Units of the columns of tables that state none, one for each quantity: `N,N m,mV/V`.",
)
moment_center_option: Callable[[F], F] = click.option(
    "--moment-center",
    "moment_center",
    type=(float, float, float),
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
    from balance_cli.campaign.recording.load_table import is_point_table, runs_of_table

    paths, used = tuple(paths), tuple(disjoint_from)
    files = [path for path in paths if not is_point_table(path)]
    runs = list(session.runs(files, geometry, skip_bad, role, used)) if files else []
    for path in paths:
        if not is_point_table(path):
            continue
        for run in runs_of_table(open_table(session, path, geometry, reading, role), geometry):
            if run.name in {other.name for other in (*used, *runs)}:
                fault = f"has the run `{run.name}`, which another file has too"
                raise UserError(fault, str(path), remedy="Rename one of the two, and give each file once")
            runs.append(run)
    return tuple(runs)


def open_table(session: Session, path: Path, geometry: Geometry, reading: TableReading, role: str) -> LoadTable:
    """Read a point table, record it as an input, and warn about columns that are not used."""
    from balance_cli.campaign.recording.load_table import read_load_table

    table = read_load_table(path, geometry, reading)
    if table.unused:
        session.warn(f"{path}: columns not used: {', '.join(table.unused)}")
    session.record_input(path.name, role, table.digest)
    return table
