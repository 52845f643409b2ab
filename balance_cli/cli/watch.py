"""`balance watch`: a quick look at each run as it appears in a folder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from balance_cli.cli.common import Session, balance_command
from balance_cli.cli.errors import EXIT_RUNS_SKIPPED
from balance_cli.cli.options import InputFile, InputFolder, NumberRange, OutputFolder
from balance_cli.cli.reduce_inputs import read_calibration, read_response
from balance_cli.io.errors import UserError
from balance_cli.reduction.choices import MOST_HARMONICS

if TYPE_CHECKING:
    from balance_cli.cli.watching.watch import Watch


@balance_command("watch")
@click.argument("folder", type=InputFolder(), metavar="DIR")
@click.option("--calibration", type=InputFile(), metavar="CAL", help="Static calibration.")
@click.option("--model", type=InputFile(), metavar="MODEL", help="Response from this model.")
@click.option("--transfer", type=InputFile(), metavar="TF", help="Response as measured, interpolated.")
@click.option("--zero", type=InputFile(), metavar="RUN", help="Wind-off record.  [default: the newest zero run in DIR]")
@click.option(
    "--harmonics",
    metavar="N",
    type=click.IntRange(1, MOST_HARMONICS),
    help="Highest rotor harmonic.  [default: as reduce]",
)
@click.option(
    "--every",
    metavar="SECONDS",
    type=NumberRange(0.05, 3600),
    default=0.5,
    show_default=True,
    help="Seconds between two looks.",
)
@click.option("--once", is_flag=True, help="End when all files in DIR are processed.")
@click.option(
    "--idle", type=NumberRange(0.1), metavar="SECONDS", help="End when no new file has appeared for this time."
)
@click.option(
    "--page-runs",
    metavar="N",
    type=click.IntRange(1, 1000),
    default=12,
    show_default=True,
    help="Newest runs on the page.",
)
@click.option("-o", "--output", type=OutputFolder(), required=True, metavar="RESULTS", help="Folder of the results.")
def command(
    session: Session,
    folder: Path,
    calibration: Path | None,
    model: Path | None,
    transfer: Path | None,
    zero: Path | None,
    harmonics: int | None,
    every: float,
    once: bool,
    idle: float | None,
    page_runs: int,
    output: Path,
) -> None:
    """Watch a folder: check and reduce each run as it appears.

    A page shows the newest loads. A file is used when its size and time no longer change, and it can be read. RESULTS
    then holds page.html, which a browser reloads by itself, loads.h5 with all runs, and journal.jsonl with a line for
    each file: its loads and whether to trust them, or why it was skipped. Files that cannot be used are skipped; one
    that changes is reduced again. A zero run serves the runs that were recorded after
    it.

    End it with Ctrl-C, --once or --idle. The same call then resumes where it stopped.
    """
    from balance_cli.cli.pipeline.folder import LOGS, locked_folder, require_absent
    from balance_cli.cli.watching.watch import RESULT_NAMES

    _check_options(folder, model, transfer, output)
    if not (output / LOGS).is_dir():  # which is there from the start of the first call
        require_absent([output / name for name in RESULT_NAMES], "watch")
    if zero is not None and calibration is None:
        raise UserError("needs a static calibration", "--zero", remedy="Add --calibration CAL, or leave it out")
    cal = read_calibration(session, calibration)
    with locked_folder(output):
        watch = _start(session, folder, (cal, model, transfer, zero, harmonics), output, page_runs)
        if once:
            watch.patience = 0.0  # what is there is taken as whole
        watch.loop(every, once, idle)
    session.status = EXIT_RUNS_SKIPPED if watch.counts["skipped"] else 0
    session.finish(watch.summary(), watch.text())


def _check_options(folder: Path, model: Path | None, transfer: Path | None, output: Path) -> None:
    if not folder.is_dir():
        raise UserError("is not a folder", str(folder), remedy="Give the folder into which the runs are written")
    if (model is None) == (transfer is None):
        raise UserError("exactly one response is needed", "--model, --transfer", remedy="Give one of the two")
    if output.resolve() == folder.resolve():
        raise UserError("is the watched folder itself", str(output), remedy="Give another folder, for example in it")


def _start(session: Session, folder: Path, given: tuple[Any, ...], output: Path, page_runs: int) -> Watch:
    """Return the watch with what an earlier call has done."""
    from balance_cli.cli.reduce_runs import MethodOptions, Reduction
    from balance_cli.cli.watching.folder import WatchedFolder
    from balance_cli.cli.watching.quick_look import QuickLook
    from balance_cli.cli.watching.watch import Watch
    from balance_cli.reduction.choices import HARMONIC
    from balance_cli.signals.response.choices import INTERPOLATIONS

    calibration, model, transfer, zero, harmonics = given
    geometry, source, usual_noise = read_response(session, calibration, model, transfer, INTERPOLATIONS[0])
    options = MethodOptions(HARMONIC, None, None, harmonics or 0)
    reduction = Reduction(options, geometry, calibration, source, None, None, usual_noise=usual_noise)
    quick_look = QuickLook(session, reduction, harmonics, zero is not None)
    if zero is not None:
        quick_look.use_zero(*session.runs([zero], geometry, role="zero"))
    watch = Watch(session, WatchedFolder(folder), quick_look, output, page_runs)
    watch.restore()
    return watch
