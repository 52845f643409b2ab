"""`balance report`: one page with the results of all artefacts given."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from balance_cli.cli.common import InputFile, OutputFile, Session, balance_command, output_option
from balance_cli.io.errors import UserError

if TYPE_CHECKING:
    from balance_cli.report.page import Page
    from balance_cli.report.sources import Sources

PICTURE_SUFFIXES = (".png", ".svg", ".pdf")


@balance_command("report")
@click.argument("artefacts", type=InputFile(), nargs=-1, required=True, metavar="ARTEFACT...")
@click.option(
    "--picture",
    type=OutputFile(),
    metavar="FILE",
    help="Also write the comparison of the methods on the check runs as .png, .svg or .pdf.",
)
@output_option("REPORT.html", "The page, one self-contained file.")
def command(session: Session, artefacts: tuple[Path, ...], picture: Path | None, output: Path) -> None:
    """One self-contained page with pictures, from artefacts alone.

    Any artefacts can be given; each adds its sections to the page. Models, measured responses and loads given together
    are compared with each other.
    """
    from balance_cli.report.page import build_page
    from balance_cli.report.sources import ARTEFACT_TYPES, group_sources

    _check_names(output, picture)
    paths = session.progress(artefacts, "artefacts", len(artefacts))
    report_sources = group_sources([(path, session.artefact(path, ARTEFACT_TYPES)) for path in paths])
    html_page = build_page(report_sources)
    session.stage(output).write_text(html_page.html, encoding="utf-8")
    if picture is not None:
        _draw_comparison(session, picture, report_sources)
    session.finish(
        {"sections": html_page.sections, "figures": html_page.pictures, "artefacts": _source_labels(report_sources)},
        _report_text(html_page, report_sources),
    )


def _check_names(output: Path, picture: Path | None) -> None:
    if output.suffix.lower() not in (".html", ".htm"):
        raise UserError("the page is written as .html", str(output), remedy="Give a name that ends in .html")
    if picture is not None and picture.suffix.lower() not in PICTURE_SUFFIXES:
        raise UserError(
            "a picture is written as .png, .svg or .pdf", str(picture), remedy="Give a name with one of these endings"
        )


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
        f"{len(report_sources.all_sources)} artefacts, {len(html_page.sections)} sections, {len(html_page.pictures)} "
        "pictures"
    )
    for source in report_sources.all_sources:
        yield f"   {source.file}: {source.label}"
