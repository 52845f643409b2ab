"""The file of the loads of `reduce` and `merge`: an artefact, or the table as CSV."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from balance_cli.cli.common import Session
from balance_cli.io.atomic import os_errors_as_user_error
from balance_cli.io.errors import UserError
from balance_cli.io.formats import LOADS_FORMAT
from balance_cli.io.formula_cells import text_cell
from balance_cli.reduction.choices import TABLE_SUFFIXES

if TYPE_CHECKING:
    from balance_cli.io.artefacts import Provenance
    from balance_cli.reduction.result import HubLoads


SUFFIX_REMEDY = "End its name with .csv or .h5; `balance export` makes Parquet and other formats of an .h5"


def check_table_suffix(output: Path) -> None:
    """Raise UserError unless the name says which of the two is wanted."""
    if output.suffix not in TABLE_SUFFIXES:
        raise UserError("the table is written as .csv or .h5", str(output), remedy=SUFFIX_REMEDY)


def write_loads(session: Session, output: Path, loads: HubLoads, provenance: Provenance | None = None) -> None:
    """Write loads in the form that the name of the output says, an artefact with a provenance other than the usual."""
    if output.suffix == ".h5":
        session.save(output, LOADS_FORMAT, loads, provenance)
        return
    part = session.stage(output)
    with (
        os_errors_as_user_error(output),
        part.open("w", encoding="utf-8", errors="backslashreplace", newline="") as file,
    ):
        _write_csv(file, loads)


def _write_csv(file: TextIO, loads: HubLoads) -> None:
    """Write the table as its data frame would be written; pandas takes longer to import than a run to reduce."""
    from balance_cli.reduction.result import LOAD_TABLE_COLUMNS, load_rows

    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(LOAD_TABLE_COLUMNS)
    for run in loads.runs.values():
        name = text_cell(run.run)
        for _, *values in load_rows(run):
            writer.writerow((name, *("" if value != value else value for value in values)))
