"""The page: all sections in order, in one self-contained HTML file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.resources import files

from jinja2 import Environment, StrictUndefined, select_autoescape
from markupsafe import Markup

from balance_cli.report import (
    calibration,
    check_runs,
    diagnosis,
    frequencies,
    in_time,
    parameters,
    provenance,
    responses,
    summary,
    transfer,
    wind_on,
)
from balance_cli.report.blocks import Section, pictures
from balance_cli.report.sources import Sources

# Results first, then the measurements and fits behind them.
SECTIONS: tuple[Callable[[Sources], Section | None], ...] = (
    summary.section,
    check_runs.section,
    wind_on.section,
    in_time.section,
    diagnosis.section,
    frequencies.section,
    responses.section,
    parameters.section,
    transfer.section,
    calibration.section,
    provenance.section,
)


@dataclass(frozen=True)
class Page:
    """A page: its HTML, {section key: title} and the names of its pictures, in order."""

    html: str
    sections: dict[str, str]
    pictures: tuple[str, ...]


def build_page(sources: Sources) -> Page:
    """Build the whole page; a section without content is left out."""
    made_sections = tuple(build_sections(sources))
    rig = summary.rig_title(sources)
    title = f"Rotor balance {rig}" if rig else "Rotor balance"
    style = Markup(_read_resource("page.css"))
    html = (
        _template_environment()
        .from_string(_read_resource("page.html"))
        .render(title=title, sections=made_sections, style=style)
    )
    names = tuple(picture.name for section in made_sections for picture in pictures(section.blocks))
    return Page(html, {section.key: section.title for section in made_sections}, names)


def build_sections(sources: Sources) -> Iterator[Section]:
    """Yield every section for which there are artefacts."""
    for make in SECTIONS:
        section = make(sources)
        if section is not None:
            yield section


def _read_resource(name: str) -> str:
    return files("balance_cli.report").joinpath(name).read_text(encoding="utf-8")


def _template_environment() -> Environment:
    return Environment(
        autoescape=select_autoescape(default_for_string=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
