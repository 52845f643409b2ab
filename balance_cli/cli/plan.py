"""`balance plan`: which runs to make in the time of a hall, and what they will tell."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from balance_cli.cli.common import Session, balance_command, geometry_option, output_option, skip_bad_option
from balance_cli.cli.options import InputFile, OutputFile
from balance_cli.diagnosis.significance import SIGNIFICANCE_LEVEL
from balance_cli.io.errors import UserError
from balance_cli.io.formats import MODEL_FORMAT
from balance_cli.planning.choices import AIMS, Aim

if TYPE_CHECKING:
    from balance_cli.campaign.recording.run import Run
    from balance_cli.campaign.rig.geometry import Geometry
    from balance_cli.estimation.identified_model import IdentifiedModel
    from balance_cli.estimation.measured_spectra import Spectra
    from balance_cli.planning.hall import Hall


@balance_command("plan")
@geometry_option
@click.argument("files", type=InputFile(), nargs=-1, metavar="[MODEL] [RUN...]")
@click.option("--minutes", type=click.FloatRange(min=0, min_open=True), required=True, help="Hall time to be planned.")
@click.option(
    "--hall", type=InputFile(), metavar="HALL", help="What the hall allows: exciters, ranges, times (YAML, see files)."
)
@click.option(
    "--aim",
    type=click.Choice(AIMS),
    default="both",
    show_default=True,
    help="Find effects, make the hub loads certain, or both.",
)
@click.option(
    "--level",
    type=click.FloatRange(min=0, max=1, min_open=True, max_open=True),
    default=SIGNIFICANCE_LEVEL,
    show_default=True,
    help="False-alarm level of a diagnosis, for all candidate effects together.",
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of the rehearsals.")
@click.option("--sheets", type=OutputFile(), metavar="FILE", help="Also write a sheet for each run, in Markdown.")
@skip_bad_option
@output_option("PLAN", "YAML file for the plan, which `balance simulate --plan` takes.")
def command(
    session: Session,
    geometry: Path,
    files: tuple[Path, ...],
    minutes: float,
    hall: Path | None,
    aim: Aim,
    level: float,
    seed: int,
    sheets: Path | None,
    skip_bad: bool,
    output: Path,
) -> None:
    """Plan the sweeps that tell most of effects and hub loads in the time of a hall.

    MODEL is a model of `identify` or `diagnose`, RUN... are runs already made: their information counts, and their
    noise is that of the plan. Without them the geometry is taken as declared. Every run that could be made is simulated
    once, and its information on all parameters computed as `identify` and `diagnose` do.
    """
    from balance_cli.cli.plan_text import plan_file_text, plan_summary, plan_text
    from balance_cli.planning.detectability import DetectionLevel
    from balance_cli.planning.sheets import sheets_text
    from balance_cli.steps.plan import PlanOptions, plan_campaign

    rig = session.geometry(geometry)
    constraints = _read_hall(session, hall)
    model, records = _read_files(session, files, rig, skip_bad)
    options = PlanOptions(minutes, aim, DetectionLevel(level), constraints, seed)
    try:
        spectra = _spectra(session, records, model.geometry if model else rig)
        planned = plan_campaign(rig, options, model, spectra, lambda runs, text, n: session.progress(runs, text, n))
    except UserError as error:
        raise error.with_location(str(hall or geometry)) from error
    session.write_text(output, plan_file_text(planned))
    if sheets is not None:
        session.write_text(sheets, sheets_text(planned))
    session.finish(plan_summary(planned), plan_text(planned))


def _read_hall(session: Session, path: Path | None) -> Hall:
    from balance_cli.planning.hall import open_hall
    from balance_cli.planning.hall_file import load_hall

    if path is None:
        session.warn("no --hall: levels, times and exciters are assumed; see the table of levels")
        return open_hall()
    return load_hall(path)


def _read_files(
    session: Session, files: Sequence[Path], geometry: Geometry, skip_bad: bool
) -> tuple[IdentifiedModel | None, tuple[Run, ...]]:
    """The model among the files, and the runs. Raises UserError for a second model, or one of another rig."""
    from balance_cli.estimation.identified_model import IdentifiedModel
    from balance_cli.io.sniff import sniff_format

    models = [path for path in files if sniff_format(path) == MODEL_FORMAT]
    if len(models) > 1:
        raise UserError("is a second model", str(models[1]), remedy="Give one model")
    model: IdentifiedModel | None = None
    if models:
        model = session.artefact(models[0], {MODEL_FORMAT: IdentifiedModel}, "model").content
        if model.geometry.rig != geometry.rig:
            fault = f"is a model of the rig {model.geometry.rig}, the geometry is of {geometry.rig}"
            raise UserError(fault, str(models[0]), remedy="Give the geometry of this model")
    return model, session.runs([path for path in files if path not in models], geometry, skip_bad)


def _spectra(session: Session, records: Sequence[Run], geometry: Geometry) -> Spectra:
    from balance_cli.estimation.measured_spectra import measured_spectra

    spectra = measured_spectra(session.progress(records, "spectra", len(records)), geometry, means=True)
    for name, reason in spectra.unused.items():
        session.report_left_out(name, reason)
    return spectra
