"""`balance export`: a result in the format of another program."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from balance_cli.cli.common import Session, balance_command
from balance_cli.cli.options import InputFile, OutputFile
from balance_cli.io.atomic import os_errors_as_user_error
from balance_cli.io.errors import UserError
from balance_cli.io.formats import HISTORY_FORMAT
from balance_cli.io.sniff import sniff_format

if TYPE_CHECKING:
    from balance_cli.io.artefacts import Artefact

FORMAT_NAMES = ("csv", "parquet", "mat", "uff", "nexus", "netcdf")


@balance_command("export")
@click.argument("artefact", type=InputFile(), metavar="ARTEFACT")
@click.option(
    "--format",
    "format",
    type=click.Choice(FORMAT_NAMES),
    help="Format.  [default: by the name of FILE: .csv, .parquet, .mat, .uff or .unv, .h5 or .nxs, .nc; csv for `-`]",
)
@click.option("--wide", is_flag=True, help="A table of loads with a row for each run and a column for each quantity.")
@click.option("-o", "--output", type=OutputFile(allow_dash=True), required=True, metavar="FILE", help="`-` is stdout.")
def command(session: Session, artefact: Path, format: str | None, wide: bool, output: Path) -> None:
    """Write a result in the format of another program.

    ARTEFACT may be a history of `reduce --history`, too: a table then has a row for each sample. Other tables (CSV,
    Parquet) have a row for each value. MAT has a struct for each run. UFF holds frequency responses and histories
    (datasets 151, 164, 58). HDF5 has NeXus attributes, so that viewers plot it. netCDF holds one run; it
    needs xarray.
    """
    from balance_cli.api.artefacts import ARTEFACT_TYPES
    from balance_cli.exporters.formats import SUFFIXES, export_bytes

    to_stdout = str(output) == "-"
    file_format = format or ("csv" if to_stdout else SUFFIXES.get(output.suffix.lower()))
    if file_format is None:
        fault = f"its ending `{output.suffix}` names no format"
        raise UserError(fault, str(output), remedy=f"End it with {', '.join(SUFFIXES)}, or give --format")
    if to_stdout and session.json_to_stdout:
        raise UserError("stdout cannot hold both", "-o - --json -", remedy="Write one of them to a file")
    item = (
        _read_history(session, artefact)
        if sniff_format(artefact) == HISTORY_FORMAT
        else session.artefact(artefact, ARTEFACT_TYPES)
    )
    try:
        content = export_bytes(item, file_format, wide)
    except UserError as error:
        raise error.with_location(file=str(artefact)) from error
    if to_stdout:
        sys.stdout.flush()
        sys.stdout.buffer.write(content)
        sys.stdout.buffer.flush()
    else:
        part = session.stage(output)
        with os_errors_as_user_error(output):
            part.write_bytes(content)
    session.finish({"format": file_format, "bytes": len(content)})


def _read_history(session: Session, path: Path) -> Artefact:
    """Return the loads over time of a run as an artefact, and record them as an input."""
    from hashlib import sha256

    from balance_cli.io.artefacts import Artefact, make_provenance
    from balance_cli.reduction.stored_history import read_history

    history = read_history(path)
    digest = sha256(history.time.tobytes() + history.loads.tobytes() + history.sigma.tobytes()).hexdigest()
    session.record_input(history.run, "history", digest)
    return Artefact(HISTORY_FORMAT, history, make_provenance("reduce", {}, ()), digest)
