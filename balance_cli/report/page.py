"""The page: all sections in order, in one self-contained HTML file."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files

from jinja2 import Environment, StrictUndefined, select_autoescape
from markupsafe import Markup

from balance_cli.report import (
    calibration,
    calibration_history,
    check_runs,
    diagnosis,
    frequencies,
    in_time,
    load_spectra,
    mode_pictures,
    parameters,
    plan_section,
    provenance,
    raw_runs,
    responses,
    summary,
    transfer,
    wind_on,
)
from balance_cli.report.blocks import Chart, Paragraph, Picture, Section, pictures
from balance_cli.report.data_tables import data_tables
from balance_cli.report.few_runs import condense
from balance_cli.report.plot_data import chart_json
from balance_cli.report.sources import Sources
from balance_cli.report.static_plot import plot_svg

STYLES = ("page.css", "chart.css", "vendor/uPlot.min.css")
SCRIPTS = ("vendor/uPlot.iife.min.js", "charts.js", "tables.js", "runs.js")
"""uPlot by Leon Sorokin, MIT license (vendor/uPlot-LICENSE.txt), then the page's own scripts."""

# Results first, then the measurements and fits behind them, then the methods that are only compared.
SECTIONS: tuple[Callable[[Sources], Section | None], ...] = (
    summary.section,
    plan_section.section,
    wind_on.section,
    load_spectra.section,
    raw_runs.section,
    in_time.section,
    diagnosis.section,
    frequencies.section,
    mode_pictures.section,
    responses.section,
    parameters.section,
    check_runs.section,
    transfer.section,
    calibration.section,
    calibration_history.section,
    provenance.section,
)


@dataclass(frozen=True)
class Page:
    """A page: its HTML, {section key: title}, the names of its pictures in order, and the pictures themselves."""

    html: str
    sections: dict[str, str]
    pictures: tuple[str, ...]
    picture_blocks: tuple[Picture | Chart, ...] = ()


def build_page(sources: Sources) -> Page:
    """Build the whole page; a section without content is left out."""
    made_sections = tuple(build_sections(sources))
    title = summary.page_title(sources)
    shown = _pictures_of(made_sections)
    names = tuple(picture.name for picture in shown)
    html = render_page(title, made_sections)
    return Page(html, {section.key: section.title for section in made_sections}, names, shown)


def render_page(title: str, sections: Sequence[Section]) -> str:
    """Return the HTML of a page with these sections."""
    template = _template_environment().from_string(_read_resource("page.html"))
    return template.render(
        title=title,
        sections=sections,
        style=Markup("\n".join(map(_read_resource, STYLES))),
        scripts=[Markup(_read_resource(name)) for name in SCRIPTS],
        numbers={picture.name: number for number, picture in enumerate(_pictures_of(sections), 1)},
    )


def _pictures_of(sections: Sequence[Section]) -> tuple[Picture | Chart, ...]:
    return tuple(picture for section in sections for picture in pictures(section.blocks))


def build_sections(sources: Sources) -> Iterator[Section]:
    """Yield every section for which there are artefacts."""
    condensed, words = condense(sources)
    for make in SECTIONS:
        section = make(sources if make is summary.section else condensed)
        if section is not None and words and section.key == "wind-on":
            section = replace(section, blocks=(Paragraph(words), *section.blocks))
        if section is not None:
            yield section


def _read_resource(name: str) -> str:
    return files("balance_cli.report").joinpath(name).read_text(encoding="utf-8")


def _template_environment() -> Environment:
    environment = Environment(
        autoescape=select_autoescape(default_for_string=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals.update(plot_svg=plot_svg, chart_json=chart_json, data_tables=data_tables)
    return environment
