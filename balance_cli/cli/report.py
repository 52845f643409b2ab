"""`balance report`: one page with the results of all artefacts given."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from balance_cli.cli.common import Session, balance_command
from balance_cli.cli.options import InputFile, OutputFile, output_option
from balance_cli.io.errors import UserError
from balance_cli.io.formats import PLAN_FORMAT, RUN_FORMAT
from balance_cli.io.result_view import plural
from balance_cli.io.sniff import sniff_format

if TYPE_CHECKING:
    from balance_cli.campaign.recording.run import Run
    from balance_cli.planning.stored_forecast import StoredPlan
    from balance_cli.report.page import Page
    from balance_cli.report.sources import Sources

PICTURE_SUFFIXES = (".png", ".svg", ".pdf")
COMPARISON = "check-runs"
"""The figure that is drawn as .png and .pdf too, under any name."""
LIKELY_MEANT = 0.8
"""Likeness of names from which one figure is taken to be meant: one wrong letter in five."""


@balance_command("report")
@click.argument("artefacts", type=InputFile(), nargs=-1, required=True, metavar="ARTEFACT... [PLAN] [RUN...]")
@click.option(
    "--picture",
    type=OutputFile(),
    metavar="FILE",
    help="Also write one picture: NAME.svg of a figure of the page, such as azimuth.svg (--json lists the names), or "
    "a .png or .pdf of the comparison of the methods on the check runs.",
)
@click.option("--run", "names", multiple=True, metavar="NAME", help="Only the loads of this run. Repeatable.")
@click.option("--pdf", type=OutputFile(), metavar="FILE", help="Also print the page to a PDF, with Chromium or Chrome.")
@click.option("--open", "open_page", is_flag=True, help="Show the page in the browser when it is written.")
@output_option("REPORT.html", "The page, one self-contained file.")
def command(
    session: Session,
    artefacts: tuple[Path, ...],
    picture: Path | None,
    names: tuple[str, ...],
    pdf: Path | None,
    open_page: bool,
    output: Path,
) -> None:
    """Make a self-contained page with pictures from results.

    Any artefacts can be given; each adds its sections to the page. Models, measured responses and loads given together
    are compared with each other. Give several calibrations oldest first: their history is drawn in this order. Run
    files among them add their channels and spectra, plans of `balance plan` their forecast.
    """
    from balance_cli.api.artefacts import ARTEFACT_TYPES
    from balance_cli.cli.browser import print_pdf, show_page
    from balance_cli.report.page import build_page
    from balance_cli.report.sources import group_sources

    _check_names(output, picture, pdf)
    run_paths = [path for path in artefacts if sniff_format(path) == RUN_FORMAT]
    if len(run_paths) == len(artefacts):
        fault = "is a run file, and no artefact is among the files"
        raise UserError(fault, str(run_paths[0]), remedy="Add results, for example loads")
    plan_paths = [path for path in artefacts if sniff_format(path) == PLAN_FORMAT]
    others = [path for path in artefacts if path not in (*run_paths, *plan_paths)]
    paths = session.progress(others, "artefacts", len(others))
    read_artefacts = [(path, session.artefact(path, ARTEFACT_TYPES)) for path in paths]
    report_sources = group_sources(read_artefacts, _open_runs(session, run_paths), _read_plans(session, plan_paths))
    if names:
        report_sources = _select_runs(report_sources, names)
    with session.working("page"):
        html_page = build_page(report_sources)
    session.write_text(output, html_page.html)
    if picture is not None:
        _write_picture(session, picture, html_page, report_sources)
    if pdf is not None:
        session.stage(pdf).write_bytes(print_pdf(html_page.html))
    if open_page:
        # The page is moved to its place when the command has returned.
        click.get_current_context().call_on_close(lambda: show_page(output))
    session.finish(
        {"sections": html_page.sections, "figures": html_page.pictures, "artefacts": _source_labels(report_sources)},
        _report_text(html_page, report_sources),
    )


def _select_runs(report_sources: Sources, names: Sequence[str]) -> Sources:
    """Keep the loads of these runs alone."""
    from balance_cli.report.few_runs import with_runs

    known = list(dict.fromkeys(name for source in report_sources.loads for name in source.content.runs))
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=3, cutoff=0.0)
            remedy = f"The nearest runs are {', '.join(near)}" if near else "Give loads that were reduced from it"
            raise UserError(f"no loads of a run `{name}`", f"--run {name}", remedy=remedy)
    return with_runs(report_sources, set(names))


def _open_runs(session: Session, paths: Sequence[Path]) -> list[Run]:
    """Open run files of one name each and record them as inputs."""
    from balance_cli.campaign.recording.run_file import open_run, require_disjoint

    runs: list[Run] = []
    for path in paths:
        run = open_run(path)
        require_disjoint([run], runs)
        session.record_input(run.name, "run", run.digest)
        runs.append(run)
    return runs


def _read_plans(session: Session, paths: Sequence[Path]) -> list[StoredPlan]:
    """Read plans with their forecasts and record them as inputs."""
    from hashlib import sha256

    from balance_cli.planning.stored_forecast import read_stored_plan

    plans = []
    for path in paths:
        plans.append(read_stored_plan(path))
        session.record_input(path.name, "plan", sha256(path.read_bytes()).hexdigest())
    return plans


def _check_names(output: Path, picture: Path | None, pdf: Path | None) -> None:
    if output.suffix.lower() not in (".html", ".htm"):
        raise UserError("the page is written as .html", str(output), remedy="Give a name that ends in .html")
    if picture is not None and picture.suffix.lower() not in PICTURE_SUFFIXES:
        raise UserError(
            "a picture is written as .png, .svg or .pdf", str(picture), remedy="Give a name with one of these endings"
        )
    if pdf is not None and pdf.suffix.lower() != ".pdf":
        raise UserError("the printed page is a .pdf", str(pdf), remedy="Give a name that ends in .pdf")


def _write_picture(session: Session, picture: Path, html_page: Page, report_sources: Sources) -> None:
    """Write the figure of the page that has the name of the file; as .png or .pdf the comparison of the methods."""
    from balance_cli.report.static_plot import picture_svg

    names = f"Figures of this page: {', '.join(sorted(html_page.pictures))}"
    if picture.suffix.lower() == ".svg":
        named = next((block for block in html_page.picture_blocks if block.name == picture.stem), None)
        if named is None:
            raise UserError(f"the page has no figure `{picture.stem}`", f"--picture {picture}", remedy=names)
        session.write_text(picture, picture_svg(named))
        return
    others = [name for name in html_page.pictures if name != COMPARISON]
    if difflib.get_close_matches(picture.stem, others, n=1, cutoff=LIKELY_MEANT):
        fault = f"only the comparison of the methods is drawn as {picture.suffix.lower()}, all other figures as .svg"
        raise UserError(fault, f"--picture {picture}", remedy=f"Give {picture.stem}.svg. {names}")
    _draw_comparison(session, picture, report_sources)


def _draw_comparison(session: Session, picture: Path, report_sources: Sources) -> None:
    from balance_cli.report.check_errors import loads_with_check_runs
    from balance_cli.report.check_figures import comparison_figure
    from balance_cli.report.figure_style import save_picture

    methods = loads_with_check_runs(report_sources)
    if not methods:
        raise UserError("no loads of check runs to draw", "--picture", remedy="Give loads reduced from check runs")
    file_format = picture.suffix.lower().lstrip(".")
    save_picture(session.stage(picture), "picture", lambda: comparison_figure(methods), file_format)


def _source_labels(report_sources: Sources) -> dict[str, str]:
    return {source.file: source.label for source in report_sources.all_sources}


def _report_text(html_page: Page, report_sources: Sources) -> Iterator[str]:
    yield (
        f"{plural(len(report_sources.all_sources), 'artefact')}, {plural(len(html_page.sections), 'section')}, "
        f"{plural(len(html_page.pictures), 'picture')}"
    )
    for source in report_sources.all_sources:
        yield f"   {source.file}: {source.label}"
