"""`balance plan`: which runs to make in the time of a hall, and what they will tell."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from balance_cli.cli.common import Session, balance_command
from balance_cli.cli.options import InputFile, NumberRange, OutputFile, geometry_option, skip_bad_option
from balance_cli.cli.plan_static import plan_static
from balance_cli.diagnosis.choices import SIGNIFICANCE_LEVEL
from balance_cli.io.errors import UserError
from balance_cli.io.formats import MODEL_FORMAT
from balance_cli.planning.choices import AIMS, TERM_SETS, Aim, TermSet

if TYPE_CHECKING:
    from balance_cli.campaign.recording.run import Run
    from balance_cli.campaign.rig.geometry import Geometry
    from balance_cli.estimation.identified_model import IdentifiedModel
    from balance_cli.estimation.measured_spectra import Spectra
    from balance_cli.planning.candidate_runs import CandidateRun
    from balance_cli.planning.hall import Hall
    from balance_cli.steps.plan import PlanOptions


MOST_MINUTES = 1e5
"""Hall time that can be planned: ten weeks, day and night."""
FOLLOWING = {"bands": "levels of the runs", "runs": "choice of the runs", "forecast": "comparison of effects"}
"""What a plan does after each of its loops."""


@dataclass(frozen=True)
class PlanFiles:
    """The files that a plan is written to."""

    plan: Path
    sheets: Path | None
    lines: Path | None


@balance_command("plan")
@geometry_option
@click.argument("files", type=InputFile(), nargs=-1, metavar="[MODEL] [RUN...]")
@click.option(
    "--minutes",
    metavar="MINUTES",
    type=NumberRange(0, MOST_MINUTES, min_open=True, max_open=True),
    help="Hall time to be planned.",
)
@click.option(
    "--hall", type=InputFile(), metavar="HALL", help="What the hall allows: exciters, ranges, times (YAML, see files)."
)
@click.option(
    "--aim",
    type=click.Choice(AIMS),
    default="both",
    show_default=True,
    help="What to optimize: finding effects, a small sigma of the hub loads, or both.",
)
@click.option(
    "--level",
    metavar="P",
    type=NumberRange(min=0, max=1, min_open=True, max_open=True),
    default=SIGNIFICANCE_LEVEL,
    show_default=True,
    help="False-alarm level of a diagnosis, for all candidate effects together.",
)
@click.option(
    "--seed", metavar="N", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of the rehearsals."
)
@click.option("--sheets", type=OutputFile(), metavar="FILE", help="Also write a sheet for each run, in Markdown.")
@click.option(
    "--lines",
    type=OutputFile(),
    metavar="FILE",
    help="Also write amplitude and phase of every line of the multisines, as CSV for the signal generator.",
)
@click.option(
    "--time-limit",
    type=NumberRange(min=0, min_open=True, max=1e6),
    metavar="SECONDS",
    help="Computing time after which the best plan so far is written.",
)
@click.option(
    "--compare",
    type=InputFile(),
    metavar="PLAN",
    help="Plan nothing: compare the runs given with this plan, run by run.",
)
@click.option(
    "--points", metavar="N", type=click.IntRange(min=1), help="Plan a static schedule of this many load points instead."
)
@click.option(
    "--terms",
    type=click.Choice(TERM_SETS),
    default="quadratic",
    show_default=True,
    help="Terms of the calibration model that a static schedule determines: loads; with squares and products; or all.",
)
@click.option(
    "--together",
    metavar="N",
    type=click.IntRange(1, 6),
    default=2,
    show_default=True,
    help="Loads at a time in a static schedule.",
)
@skip_bad_option
@click.option(
    "-o",
    "--output",
    type=OutputFile(),
    metavar="PLAN",
    help="YAML file for the plan, which `balance simulate --plan` takes; needed without --compare.",
)
def command(
    session: Session,
    geometry: Path,
    files: tuple[Path, ...],
    minutes: float | None,
    hall: Path | None,
    aim: Aim,
    level: float,
    seed: int,
    sheets: Path | None,
    lines: Path | None,
    time_limit: float | None,
    compare: Path | None,
    points: int | None,
    terms: TermSet,
    together: int,
    skip_bad: bool,
    output: Path | None,
) -> None:
    """Plan the sweeps that are most informative in the given time.

    Informative on effects, on hub loads, or on both (--aim). MODEL is a model of `identify` or `diagnose`, RUN... are
    runs already made: their information counts, and their noise is that of the plan. Without them the geometry is taken
    as declared. Every run that could be made is simulated once, and its information on all parameters computed as
    `identify` and `diagnose` do. With --compare the runs are those of a plan that was carried out. With --points the
    plan is a static schedule: the load combinations that determine the terms of the calibration model best, compared
    with one load at a time.
    """
    from balance_cli.planning.detectability import DetectionLevel
    from balance_cli.steps.plan import PlanOptions

    if points is not None:
        _check_static_call(minutes, sheets, compare, output)
        return plan_static(session, geometry, hall, points, terms, together, output)
    _check_call(minutes, sheets, compare, output)
    rig = session.geometry(geometry)
    model, records = _read_files(session, files, rig, skip_bad)
    options = PlanOptions(minutes or 0.0, aim, DetectionLevel(level), _read_hall(session, hall), seed, time_limit)
    try:
        spectra = _spectra(session, records, model.geometry if model else rig)
        if compare is not None:
            _compare(session, rig, compare, options, spectra, model)
        elif output is not None:
            _plan(session, rig, options, spectra, model, PlanFiles(output, sheets, lines))
    except UserError as error:
        raise error.with_location(str(hall or geometry)) from error


def _check_call(minutes: float | None, sheets: Path | None, compare: Path | None, output: Path | None) -> None:
    """Raise UserError where an option is missing, or has no meaning together with --compare."""
    if compare is None and (minutes is None or output is None):
        missing = "--minutes" if minutes is None else "-o"
        raise UserError("is missing", missing, remedy="Give the hall time and the file of the plan, or --compare")
    if compare is not None and (output is not None or sheets is not None or minutes is not None):
        given = "-o" if output is not None else "--sheets" if sheets is not None else "--minutes"
        raise UserError("has no meaning with --compare", given, remedy="Leave it out; --json writes the comparison")


def _check_static_call(minutes: float | None, sheets: Path | None, compare: Path | None, output: Path | None) -> None:
    """Raise UserError where an option has no meaning together with --points, or the output is missing."""
    for option, value in (("--minutes", minutes), ("--sheets", sheets), ("--compare", compare)):
        if value is not None:
            raise UserError("has no meaning with --points", option, remedy="Leave it out")
    if output is None:
        raise UserError("is missing", "-o", remedy="Give the file of the plan")


def _plan(
    session: Session,
    rig: Geometry,
    options: PlanOptions,
    spectra: Spectra,
    model: IdentifiedModel | None,
    files: PlanFiles,
) -> None:
    from balance_cli.cli.plan_text import plan_file_text, plan_summary, plan_text
    from balance_cli.planning.sheets import lines_table, sheets_text
    from balance_cli.steps.plan import plan_campaign

    with ExitStack() as between:

        def show(runs: Iterable[CandidateRun], text: str, count: int) -> Iterator[CandidateRun]:
            between.close()
            yield from session.progress(runs, text, count, False)
            between.enter_context(session.working(FOLLOWING[text]))

        planned = plan_campaign(rig, options, model, spectra, show)
    session.write_text(files.plan, plan_file_text(planned))
    if files.sheets is not None:
        session.write_text(files.sheets, sheets_text(planned))
    if files.lines is not None:
        session.write_text(files.lines, lines_table(planned))
    session.finish(plan_summary(planned), plan_text(planned))


def _compare(
    session: Session,
    rig: Geometry,
    compare: Path,
    options: PlanOptions,
    spectra: Spectra,
    model: IdentifiedModel | None,
) -> None:
    from balance_cli.cli.plan_comparison import comparison_summary, comparison_text
    from balance_cli.simulation.files import read_plan
    from balance_cli.steps.compare_plan import compare_plan

    comparison = compare_plan(rig, read_plan(compare), options, spectra, model)
    session.finish(comparison_summary(comparison), comparison_text(comparison))


def _read_hall(session: Session, path: Path | None) -> Hall:
    from balance_cli.planning.hall import open_hall
    from balance_cli.planning.hall_file import load_hall

    if path is None:
        session.warn("no --hall: times are assumed, and exciters of any force; check the levels of the runs")
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

    spectra = measured_spectra(session.progress(records, "spectra", len(records), False), geometry, means=True)
    for name, reason in spectra.unused.items():
        session.report_left_out(name, reason)
    return spectra
