"""`balance export`: a result in the format of another program."""

from __future__ import annotations

from pathlib import Path

import click

from balance_cli.cli.common import InputFile, OutputFile, Session, balance_command


@balance_command("export")
@click.argument("artefact", type=InputFile(), metavar="ARTEFACT")
@click.option("--wide", is_flag=True, help="A table of loads with a row for each run and a column for each quantity.")
@click.option("-o", "--output", type=OutputFile(allow_dash=True), required=True, metavar="FILE", help="File to write.")
def command(session: Session, artefact: Path, wide: bool, output: Path) -> None:
    """Write a result in the format of another program."""
    from balance_cli.exporters.tables import csv_text, long_table, wide_table
    from balance_cli.io.formats import LOADS_FORMAT
    from balance_cli.reduction.result import HubLoads

    content = session.artefact(artefact, {LOADS_FORMAT: HubLoads}).content
    table = wide_table(content) if wide else long_table(content)
    session.write_text(output, csv_text(table))
    session.finish({"rows": len(table), "columns": list(table.columns)})
