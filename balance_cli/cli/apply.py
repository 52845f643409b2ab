"""`balance apply`: static loads of point tables and static runs, by a calibration."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from balance_cli.cli.common import Session, balance_command
from balance_cli.cli.options import InputFile, WordOrFile, output_option
from balance_cli.cli.static_runs import moment_center_option, open_table, table_reading, units_option
from balance_cli.io.errors import UserError
from balance_cli.io.formats import CALIBRATION_FORMAT
from balance_cli.reduction.choices import MEAN_LOAD_METHODS, NON_ITERATIVE

if TYPE_CHECKING:
    from balance_cli.calibration.result import Calibration
    from balance_cli.campaign.recording.load_table import LoadTable, TableReading

FIRST_ROW = "first"


@balance_command("apply")
@click.argument("calibration", type=InputFile(), metavar="CAL")
@click.argument("tables", type=InputFile(), nargs=-1, required=True, metavar="TABLE...")
@click.option(
    "--zero",
    "zero",
    type=WordOrFile(),
    metavar="first|FILE",
    help="Reading of the unloaded balance: `first`, the first row of each run, or a table or run of unloaded rows. For "
    "rows of other load series, and with a file for all, sigma contains the scatter of the zeros of the calibration. "
    "Default: rows of the kind `tare`; without them the mean zero of the calibration, with the flag `no zero`.",
)
@click.option(
    "--method",
    type=click.Choice(MEAN_LOAD_METHODS),
    help="Loads by iteration with the calibration model, or directly by the model of `calibrate --non-iterative`.  "
    "[default: non-iterative where the calibration has that model]",
)
@click.option(
    "--load-units",
    "load_units",
    metavar="UNIT,...",
    help="Units of the loads written: `lbf,in-lbf`. Default: those of the loads in the table, else N and N m.",
)
@units_option
@moment_center_option
@output_option("LOADS.csv")
def command(
    session: Session,
    calibration: Path,
    tables: tuple[Path, ...],
    zero: str | None,
    method: str | None,
    load_units: str | None,
    units: str | None,
    moment_center: tuple[float, float, float] | None,
    output: Path,
) -> None:
    """Compute static loads from the readings of point tables.

    Each row of a point table (CSV) or static run becomes a row of loads. CAL is a calibration. A table has a column
    with its unit for each channel; loads, where it has them, are compared. Every load has a standard deviation. Rows
    outside the calibrated loads are flagged, not left out.
    """
    from balance_cli.calibration.load_method import choose_load_method
    from balance_cli.calibration.result import Calibration
    from balance_cli.cli.apply_output import apply_summary, apply_text, apply_warnings, loads_csv, output_units
    from balance_cli.cli.scale_text import scale_evidence_of, scale_text
    from balance_cli.steps.point_contradictions import flag_contradicted
    from balance_cli.steps.point_loads import move_moment_center
    from balance_cli.steps.point_readings import point_readings, zero_reading
    from balance_cli.steps.point_temperature import point_loads_at_temperature

    if output.suffix.lower() != ".csv":
        raise UserError("loads of a point table are written as .csv", str(output), remedy="Give it this suffix")
    artefact = session.artefact(calibration, {CALIBRATION_FORMAT: Calibration}, "calibration")
    result, reading = choose_load_method(artefact.content, method, "--method"), table_reading(units, moment_center)
    opened = [_open(session, path, result, reading) for path in tables]
    unloaded = None
    if zero not in (None, FIRST_ROW):
        assert zero is not None
        unloaded = zero_reading(_open(session, Path(zero), result, reading, "zero"))
    readings = [point_readings(table, result, zero == FIRST_ROW) for table in opened]
    loads = [point_loads_at_temperature(rows, result, unloaded, method == NON_ITERATIVE) for rows in readings]
    loads, contradicted = flag_contradicted(loads, readings, result)
    if moment_center is not None:
        loads = [move_moment_center(run, result.geometry, moment_center) for run in loads]
    columns = output_units(result, opened, load_units)
    session.write_text(output, loads_csv(opened, loads, columns))
    for note in (*apply_warnings(loads, opened, result), *contradicted):
        session.warn(note)
    summary = {**apply_summary(loads), "scale_evidence": scale_evidence_of(result)}
    session.finish(summary, [*apply_text(loads, columns), *scale_text(result)])


def _open(
    session: Session, path: Path, calibration: Calibration, reading: TableReading, role: str = "table"
) -> LoadTable:
    """Read a point table or a static run as a table."""
    from balance_cli.campaign.recording.load_table import is_point_table
    from balance_cli.steps.point_readings import table_of_run

    if is_point_table(path):
        return open_table(session, path, calibration.geometry, reading, role)
    (run,) = session.runs([path], calibration.geometry, role=role)
    return table_of_run(run, calibration.geometry)
