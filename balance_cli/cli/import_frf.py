"""The command `balance import-frf`: measured frequency responses of other programs."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from balance_cli.cli.common import Session, balance_command
from balance_cli.cli.options import InputFile, OutputFile
from balance_cli.io.errors import UserError
from balance_cli.io.formats import TRANSFER_FORMAT
from balance_cli.io.sniff import require_file

if TYPE_CHECKING:
    from balance_cli.campaign.rig.geometry import Geometry
    from balance_cli.diagnosis.consistency.findings import ConsistencyFinding
    from balance_cli.signals.response.transfer import Transfer


@balance_command("import-frf")
@click.argument("files", type=InputFile(), nargs=-1, required=True, metavar="MAP FILE...")
@click.option("-g", "--geometry", type=InputFile(), metavar="GEOMETRY", help="Geometry of the rig: channels and hub.")
@click.option(
    "--calibration",
    type=InputFile(),
    metavar="CAL",
    help="Static calibration that the responses must approach at low frequency.",
)
@click.option("--sketch", is_flag=True, help="Print a draft map of the FILEs, to be completed; no MAP is given then.")
@click.option("-o", "--output", type=OutputFile(), metavar="TF", help="Frequency responses, as those of `sweep-tf`.")
def command(
    session: Session,
    files: tuple[Path, ...],
    geometry: Path | None,
    calibration: Path | None,
    sketch: bool,
    output: Path | None,
) -> None:
    """Import frequency responses that another program has measured.

    MAP is a YAML file that says which function is which channel over which load. UFF 58 and 58b (function types 4 and
    6), MAT, HDF5 and tables of text are recognized by content. The result is used by `reduce
    --transfer`. Signs, units and phases are checked against the geometry, and against a calibration.
    """
    if sketch:
        if output is not None or calibration is not None:
            option = "-o" if output is not None else "--calibration"
            raise UserError("does not go with --sketch, which prints a map", option, remedy="Leave one of them out")
        _print_sketch(session, files, geometry)
        return
    if output is None or geometry is None or len(files) < 2:
        remedy = "Call `balance import-frf MAP FILE... -g GEOMETRY -o TF`"
        raise UserError("needs a map, files, a geometry and an output", "import-frf", remedy=remedy)
    from balance_cli.cli.consistency import report_findings, with_findings
    from balance_cli.cli.sweep_tf import response_lines, transfer_summary

    rig = session.geometry(geometry, mechanics=False)
    transfer, findings = _import(session, files[0], files[1:], rig, calibration)
    for text in transfer.consistency or ():
        session.warn(text)
    report_findings(session, findings)
    for name, reason in transfer.unused_runs.items():
        session.report_left_out(name, reason)
    for reference, channels in transfer.channels_left_out.items():
        for channel, reason in channels.items():
            session.warn(f"reference {reference}: channel {channel} left out: {reason}")
    session.save(output, TRANSFER_FORMAT, with_findings(session, transfer))
    notes = transfer.import_notes or ()
    session.finish({**transfer_summary(transfer), "notes": list(notes)}, [*response_lines(transfer), *notes])


def _import(
    session: Session, map_file: Path, files: tuple[Path, ...], rig: Geometry, calibration: Path | None
) -> tuple[Transfer, tuple[ConsistencyFinding, ...]]:
    """The responses with what was compared among their notes, and the warnings of the cross-checks."""
    from balance_cli.campaign.recording.frf_map import read_frf_map
    from balance_cli.cli.reduce_inputs import read_calibration
    from balance_cli.importers.base import TextLayout
    from balance_cli.importers.frf import open_frf
    from balance_cli.steps.frf_checks import geometry_findings, static_findings
    from balance_cli.steps.import_frf import import_responses
    from balance_cli.steps.reduction_inputs import require_same_geometry

    mapping = read_frf_map(map_file)
    layout = TextLayout(**mapping.text.model_dump())
    for path, role in ((map_file, "map"), *((path, "responses") for path in files)):
        session.record_input(path.name, role, _digest(path))
    statics = read_calibration(session, calibration)
    if statics is not None:
        require_same_geometry(rig, statics, str(calibration))
    sources = [open_frf(path, layout) for path in session.progress(files, "files", len(files))]
    try:
        transfer = import_responses(mapping, sources, rig)
        findings = geometry_findings(transfer)
    except UserError as error:
        raise error.with_location(file=str(map_file)) from error
    compared, text = static_findings(transfer, statics, str(calibration))
    return replace(transfer, import_notes=(*(transfer.import_notes or ()), text)), (*findings, *compared)


def _digest(path: Path) -> str:
    """The digest of the content of a file. Raises UserError where it cannot be read."""
    require_file(path)
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise UserError(f"cannot be read: {error.strerror or error}", str(path), remedy="Check the file") from error


def _print_sketch(session: Session, files: tuple[Path, ...], geometry: Path | None) -> None:
    from balance_cli.importers.frf import open_frf
    from balance_cli.steps.frf_sketch import sketch_frf_map

    rig = None if geometry is None else session.geometry(geometry, mechanics=False)
    text = sketch_frf_map([open_frf(path) for path in files], rig)
    session.finish({"map": text}, text.splitlines())
