"""The command `balance import`: run files from the files of other programs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from balance_cli.cli.common import Session, balance_command
from balance_cli.cli.options import InputFile, OutputFolder
from balance_cli.io.errors import UserError

if TYPE_CHECKING:
    from balance_cli.campaign.recording.import_map_file import DeclaredRun
    from balance_cli.steps.import_runs import ImportedRun

BLOCK_VALUES = 2**21
"""Numbers read at a time, 16 MB."""
BLOCK_ROWS = 2**16


@balance_command("import")
@click.argument("files", type=InputFile(), nargs=-1, required=True, metavar="MAP FILE...")
@click.option("--sketch", is_flag=True, help="Print a draft map of the FILEs, to be completed; no MAP is given then.")
@click.option(
    "-g", "--geometry", type=InputFile(), metavar="GEOMETRY", help="Geometry whose channels a sketch looks for."
)
@click.option("-o", "--output", type=OutputFolder(), metavar="DIR", help="Folder for the run files.")
def command(
    session: Session, files: tuple[Path, ...], sketch: bool, geometry: Path | None, output: Path | None
) -> None:
    """Convert files of other programs to run files.

    MAP is a YAML file that assigns the channels of the files and states which runs they are. CSV and other text, UFF 58
    and 58b, TDMS, MDF4, MAT, HDF5, WAV and Parquet are recognized by content. The 1/rev pulses are found in the signal
    of a tachometer, and channels of different rates are resampled.
    """
    if sketch and output is not None:
        raise UserError("does not go with --sketch, which prints a map", "-o", remedy="Leave one of them out")
    if geometry is not None and not sketch:
        raise UserError("has no meaning without --sketch", "-g", remedy="Leave it out; the map states the rig")
    if sketch:
        _print_sketch(session, files, geometry)
        return
    if output is None or len(files) < 2:
        raise UserError("needs a map, files and a folder", "import", remedy="Call `balance import MAP FILE... -o DIR`")
    from balance_cli.campaign.recording.import_map_file import declared_runs, read_import_map

    mapping = read_import_map(files[0])
    runs = declared_runs(mapping, files[1:], str(files[0]))
    summaries, text = {}, []
    for declared in session.progress(runs, "runs"):
        imported = _import(declared, str(files[0]))
        imported = _write(session, output, imported)
        summaries[declared.name] = _summary(imported)
        text += _lines(imported)
    session.finish({"map": str(files[0]), "rig": mapping.rig, "runs": summaries}, text)


def _import(declared: DeclaredRun, map_file: str) -> ImportedRun:
    """The run of its files, checked as any run file is."""
    from balance_cli.campaign.recording.run_checks import run_file_faults
    from balance_cli.campaign.recording.run_file import contents_of_run
    from balance_cli.importers import open_foreign
    from balance_cli.importers.base import TextLayout
    from balance_cli.steps.import_runs import import_run

    layout = TextLayout(**declared.mapping.text.model_dump())
    imported = import_run(declared, [open_foreign(path, layout) for path in declared.files])
    for fault in run_file_faults(contents_of_run(imported.run)):
        remedy = f"{fault.remedy} (entry {declared.place})"
        raise UserError(f"run `{declared.name}`: {fault.fault}", map_file, fault.place, remedy)
    return imported


def _write(session: Session, output: Path, imported: ImportedRun) -> ImportedRun:
    """Write the run file; its samples are checked on their way, and a note is made of those that are missing."""
    from balance_cli.campaign.recording.run_checks import LoadCheck, MissingSamples
    from balance_cli.campaign.recording.run_file import write_run

    run = imported.run
    check, missing, size = LoadCheck(run), MissingSamples(run), _block_rows(len(run.channel_names))
    blocks = session.progress(run.blocks(size), run.name, -(-run.samples // size))
    write_run(session.stage_in(output, f"{run.name}.h5"), run, missing.watch(check.watch(blocks)))
    for fault in check.faults():
        raise fault.with_location(file=str(run.path))
    return replace(imported, notes=(*imported.notes, *missing.notes()))


def _block_rows(channels: int) -> int:
    """Samples of a block: whole chunks of the run file."""
    return max(BLOCK_VALUES // channels // BLOCK_ROWS, 1) * BLOCK_ROWS


def _summary(imported: ImportedRun) -> dict[str, Any]:
    run, reference = imported.run, imported.reference
    rotor = None
    if reference is not None:
        rotor = {
            "pulses": len(reference.pulse_times),
            "mean_rate": reference.mean_rate,
            "azimuth_error_deg": reference.azimuth_error_deg,
            "scatter_deg": reference.scatter_deg,
            "window": reference.window,
        }
    return {
        "kind": run.kind,
        "file": str(run.path),
        "samples": run.samples,
        "sample_rate": run.sample_rate,
        "start": imported.start,
        "channels": list(run.channel_names),
        "rotor": rotor,
        "notes": list(imported.notes),
    }


def _lines(imported: ImportedRun) -> list[str]:
    return [repr(imported.run), *(f"  {note}" for note in imported.notes)]


def _print_sketch(session: Session, files: tuple[Path, ...], geometry: Path | None) -> None:
    from balance_cli.importers import open_foreign
    from balance_cli.steps.import_sketch import sketch_map

    rig = None if geometry is None else session.geometry(geometry, mechanics=False)
    text = sketch_map([open_foreign(path) for path in files], rig)
    session.finish({"map": text}, text.splitlines())
