"""Provenance of the page: artefacts, their inputs, digests, options and versions."""

from __future__ import annotations

import json

from balance_cli.report.blocks import PageBlock, Paragraph, Row, Section, Table, TableCell, plain_row
from balance_cli.report.sources import Source, Sources

DIGEST_DIGITS = 12
"""Characters of a digest that are shown, enough to tell files apart; the tooltip shows all."""


def section(sources: Sources) -> Section:
    """Artefacts, inputs and versions."""
    blocks: tuple[PageBlock, ...] = (
        Paragraph(
            "This page was made from these artefacts alone. Digests cover data, options, schema and the "
            "digests of the inputs (SHA-256; the first twelve digits are shown)."
        ),
        artefact_table(sources),
        input_table(sources),
        version_table(sources),
    )
    return Section("provenance", "Provenance", blocks)


def artefact_table(sources: Sources) -> Table:
    """One row per artefact: file, format, label, command, options, digest, time."""
    head = plain_row("file", "format", "shown as", "command", "options", "digest", "made")
    return Table("Artefacts.", (head,), tuple(_artefact_row(source) for source in sources.all_sources))


def _artefact_row(source: Source[object]) -> Row:
    provenance = source.artefact.provenance
    options = ", ".join(f"{name}={_option_text(value)}" for name, value in provenance.options.items()) or "defaults"
    texts = (source.artefact.format, source.label, f"balance {provenance.command}", options)
    digest = TableCell(source.artefact.digest[:DIGEST_DIGITS], mark="digest", title=source.artefact.digest)
    return (
        TableCell(source.file, mark="name"),
        *(TableCell(text) for text in texts),
        digest,
        TableCell(provenance.created),
    )


def _option_text(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def input_table(sources: Sources) -> Table:
    """Every input once, with the artefacts that were made from it."""
    files_by_input: dict[tuple[str, str, str], list[str]] = {}
    for source in sources.all_sources:
        for item in source.artefact.provenance.inputs:
            files_by_input.setdefault((item.role, item.name, item.digest), []).append(source.file)
    rows = []
    for (role, name, digest), files in files_by_input.items():
        short = TableCell(digest[:DIGEST_DIGITS], mark="digest", title=digest)
        rows.append((TableCell(name, mark="name"), TableCell(role), short, TableCell(", ".join(dict.fromkeys(files)))))
    head = plain_row("input", "role", "digest", "used for")
    return Table("Inputs of the artefacts.", (head,), tuple(rows))


def version_table(sources: Sources) -> Table:
    """Versions of the packages with which the artefacts were made."""
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
