"""`balance trend`: loads of many runs against their attributes and over the campaign."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from balance_cli.cli.common import Session, balance_command
from balance_cli.cli.load_text import blade_harmonic
from balance_cli.cli.options import InputFile, InputFolder, OutputFile
from balance_cli.io.errors import UserError
from balance_cli.io.formats import LOADS_FORMAT, MODEL_FORMAT
from balance_cli.io.formula_cells import text_cell

if TYPE_CHECKING:
    from balance_cli.cli.trend_text import TrendResult
    from balance_cli.reduction.operational_modes import OperationalModes
    from balance_cli.steps.trend_points import TrendPoint


@balance_command("trend")
@click.argument("loads", type=InputFile(), nargs=-1, required=True, metavar="LOADS...")
@click.option(
    "--by",
    "attribute",
    metavar="ATTRIBUTE",
    default="speed",
    show_default=True,
    help="What loads are plotted against: `speed`, or a numeric attribute of the run files.",
)
@click.option("-o", "--output", type=OutputFile(), metavar="TABLE", help="Table of the points, .csv.")
@click.option(
    "--model", type=InputFile(), metavar="MODEL", help="Follow the eigenfrequencies near those of this model."
)
@click.option("--records", type=InputFolder(), metavar="DIR", help="Folder of the run files, for --model.")
def command(
    session: Session,
    loads: tuple[Path, ...],
    attribute: str,
    output: Path | None,
    model: Path | None,
    records: Path | None,
) -> None:
    """Follow loads and eigenfrequencies over many runs.

    LOADS are .h5 files of `reduce`, from one day or many. Listed are the slopes of mean and blade harmonic over the
    attribute; runs that differ from their repeats, which are runs of the same attributes; and whether the residual test
    of the redundant channels worsens in the course of the runs, as it does when the model no longer holds.

    With --model and --records the eigenfrequencies are followed, too, as far as turbulence shows them between the
    rotor harmonics of each run: they show which mode a changed stiffness or mass has moved.
    """
    from balance_cli.cli.trend_text import find_trends, trend_summary, trend_text

    if output is not None and output.suffix != ".csv":
        raise UserError("the table is written as .csv", str(output), remedy="End its name with .csv")
    if (model is None) != (records is None):
        missing = "--records" if records is None else "--model"
        raise UserError("eigenfrequencies need the model and the run files", missing, remedy="Give both or none")
    points = _points(session, loads)
    modes = None if model is None or records is None else _modes_of_runs(session, points, model, records)
    result = find_trends(points, attribute, modes)
    if output is not None:
        session.write_text(output, _table(result))
    session.finish(trend_summary(result), trend_text(result))


def _points(session: Session, paths: tuple[Path, ...]) -> list[TrendPoint]:
    """Read the runs of all files; a warning where they are not of one geometry, response and method."""
    from balance_cli.campaign.rig.geometry_file import geometry_digest
    from balance_cli.reduction.result import HubLoads
    from balance_cli.steps.trend_points import TrendPoint

    points, kinds = [], set()
    for path in session.progress(paths, "loads", len(paths)):
        loads: HubLoads = session.artefact(path, {LOADS_FORMAT: HubLoads}, "loads").content
        kinds.add((geometry_digest(loads.geometry), loads.response, loads.method))
        fewest = min((len(run.frequency_hz) - 1 for run in loads.runs.values()), default=1)
        blades = blade_harmonic(loads.geometry, fewest)
        points += [TrendPoint(str(path), run, blades) for run in loads.runs.values()]
    if len(kinds) > 1:
        session.warn("the loads come from different geometries, responses or methods: a step may be theirs")
    if len({point.blades for point in points}) > 1:
        remedy = "Reduce them with the same harmonics"
        raise UserError("the loads have different blade harmonics", "LOADS...", remedy=remedy)
    return points


def _modes_of_runs(
    session: Session, points: Sequence[TrendPoint], model: Path, folder: Path
) -> dict[str, OperationalModes]:
    """Read the records of the runs, and return the eigenfrequencies of each; a warning for those without."""
    from balance_cli.campaign.recording.run_file import open_matching_run, run_header
    from balance_cli.estimation.identified_model import IdentifiedModel
    from balance_cli.reduction.model_sources import model_source
    from balance_cli.steps.mode_trend import run_modes

    content: IdentifiedModel = session.artefact(model, {MODEL_FORMAT: IdentifiedModel}, "model").content
    source, geometry = model_source(content), content.geometry
    if source.system is None:
        fault = "has no equations of motion, whose modes could be followed"
        raise UserError(fault, str(model), remedy="Give a model of the physical form")
    if not folder.is_dir():
        raise UserError("is not a folder", str(folder), remedy="Give the folder of the runs that were reduced")
    wanted = {point.run: point for point in points}
    modes_by_run: dict[str, OperationalModes] = {}
    reasons: list[str] = []
    paths = sorted(folder.glob("*.h5"))
    for path in session.progress(paths, "records", len(paths)):
        try:
            point = wanted.get(run_header(path, None).name)
        except UserError:
            continue  # another file of the folder
        try:
            if point is not None:
                modes_by_run[point.run] = run_modes(
                    open_matching_run(path, geometry, hold=True), point, geometry, source
                )
        except UserError as error:
            reasons.append(str(error))
    if not modes_by_run:
        reason = f"First reason: {reasons[0]}" if reasons else "Give the folder of the runs that were reduced"
        raise UserError("holds no usable record of these loads", str(folder), remedy=reason)
    if len(modes_by_run) < len(wanted):
        first = f"; the first: {reasons[0]}" if reasons else ""
        session.warn(
            f"{len(wanted) - len(modes_by_run)} of {len(wanted)} runs have no usable record in {folder}{first}"
        )
    return modes_by_run


def _table(result: TrendResult) -> str:
    """Return the points as CSV: one row for each run and component, in the order of the campaign."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = result.points[0].quantities
    heads = [head for name in names for head in (name, f"sigma_{name}")]
    writer.writerow(["run", "file", "place", result.attribute, "redundancy", "component", "unit", *heads, "outlier"])
    outliers = {(item.run, item.component, item.quantity) for item in result.outliers}
    for index in result.order:
        point = result.points[index]
        known = (result.place[index], result.values[index], result.redundancy[index])
        for component in point.components:
            numbers = [number for name in names for number in point.value(component, name)]
            odd = "; ".join(name for name in names if (point.run, component, name) in outliers)
            row = [text_cell(point.run), text_cell(Path(point.file).name), *known, component, point.unit(component)]
            writer.writerow([*row, *numbers, odd])
    return text.getvalue()
