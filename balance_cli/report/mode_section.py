"""Section of the shapes of the modes: the rig in motion, and how well two models' shapes agree."""

from __future__ import annotations

from balance_cli.report.blocks import PageBlock, Section
from balance_cli.report.frequencies import reference_model
from balance_cli.report.mode_pictures import assurance_table, shape_picture
from balance_cli.report.source_roles import SourceRole
from balance_cli.report.sources import Sources


def section(sources: Sources) -> Section | None:
    """Return the shapes of the best model, and their assurance with those computed; None without shapes."""
    best = reference_model(sources.models) or next(iter(sources.models), None)
    picture = shape_picture(best) if best is not None else None
    if best is None or picture is None:
        return None
    blocks: list[PageBlock] = [picture]
    computed = next((source for source in sources.models if source.role is SourceRole.COMPUTED), None)
    table = assurance_table(computed, best) if computed is not None and computed is not best else None
    if table is not None:
        blocks.append(table)
    return Section("shapes", "Mode shapes", tuple(blocks))
