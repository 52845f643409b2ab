"""Where everything comes from: artefacts, their inputs, digests, options and versions."""

from __future__ import annotations

import json

from balance_cli.report.blocks import PageBlock, Paragraph, Row, Section, Table, TableCell
from balance_cli.report.sources import Source, Sources

DIGEST_DIGITS = 12
"""Characters of a digest that are shown; the rest appears under the pointer."""


def section(sources: Sources) -> Section:
    """Artefacts, inputs and versions."""
    blocks: tuple[PageBlock, ...] = (
        Paragraph(
            "Everything on this page comes from these artefacts alone. Digests cover data, options, schema and the "
            "digests of the inputs (SHA-256; the first twelve digits are shown)."
        ),
        artefact_table(sources),
        input_table(sources),
        version_table(sources),
    )
    return Section("provenance", "Provenance", blocks)


def artefact_table(sources: Sources) -> Table:
    """Every artefact: file, what it is, command, options, digest, time."""
    head = tuple(TableCell(name) for name in ("file", "format", "shown as", "command", "options", "digest", "made"))
    return Table("Artefacts.", (head,), tuple(_artefact_row(source) for source in sources.all_sources))


def _artefact_row(source: Source[object]) -> Row:
    made = source.artefact.provenance
    options = ", ".join(f"{name}={_option_text(value)}" for name, value in made.options.items()) or "defaults"
    texts = (source.artefact.format, source.label, f"balance {made.command}", options)
    digest = TableCell(source.artefact.digest[:DIGEST_DIGITS], mark="digest", title=source.artefact.digest)
    return (TableCell(source.file, mark="name"), *(TableCell(text) for text in texts), digest, TableCell(made.created))


def _option_text(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def input_table(sources: Sources) -> Table:
    """Every input of every artefact once, with the artefacts that it went into."""
    used: dict[tuple[str, str, str], list[str]] = {}
    for source in sources.all_sources:
        for item in source.artefact.provenance.inputs:
            used.setdefault((item.role, item.name, item.digest), []).append(source.file)
    rows = []
    for (role, name, digest), files in used.items():
        short = TableCell(digest[:DIGEST_DIGITS], mark="digest", title=digest)
        rows.append((TableCell(name, mark="name"), TableCell(role), short, TableCell(", ".join(dict.fromkeys(files)))))
    head = tuple(TableCell(name) for name in ("input", "role", "digest", "went into"))
    return Table("Inputs of the artefacts.", (head,), tuple(rows))


def version_table(sources: Sources) -> Table:
    """Versions of the packages that made the artefacts."""
    names = dict.fromkeys(name for source in sources.all_sources for name in source.artefact.provenance.versions)
    rows = []
    for name in names:
        versions = dict.fromkeys(
            source.artefact.provenance.versions[name]
            for source in sources.all_sources
            if name in source.artefact.provenance.versions
        )
        rows.append((TableCell(name, mark="name"), TableCell(", ".join(versions))))
    return Table("Versions.", ((TableCell("package"), TableCell("version")),), tuple(rows))
