"""Section of the shapes of the modes: the rig in motion, and how well two models' shapes agree."""

from __future__ import annotations

from balance_cli.report.blocks import PageBlock, Section
from balance_cli.report.campbell import campbell_blocks
from balance_cli.report.frequencies import reference_model
from balance_cli.report.load_figures import wind_runs
from balance_cli.report.mode_pictures import assurance_table, shape_picture
from balance_cli.report.rig_drawing import rig_picture
from balance_cli.report.source_roles import SourceRole
from balance_cli.report.sources import Sources

MOST_SPEEDS = 40
"""Speeds of runs that are drawn in the Campbell diagram."""


def section(sources: Sources) -> Section | None:
    """Return the shapes of the best model, and their assurance with those computed; None without shapes."""
    best = reference_model(sources.models) or next(iter(sources.models), None)
    picture = shape_picture(best) if best is not None else None
    if best is None or picture is None:
        return None
    blocks: list[PageBlock] = [rig_picture(best.content.geometry), picture]
    computed = next((source for source in sources.models if source.role is SourceRole.COMPUTED), None)
    table = assurance_table(computed, best) if computed is not None and computed is not best else None
    if table is not None:
        blocks.append(table)
    blocks += campbell_blocks(best, _speeds(sources))
    return Section("shapes", "Mode shapes and rotor speed", tuple(blocks))


def _speeds(sources: Sources) -> tuple[float, ...]:
    """The mean speeds [Hz] of the wind-on runs, each once."""
    runs = [run for source in sources.loads for run in wind_runs(source.content).values()]
    by_harmonics = [run for run in runs if run.in_time is None and len(run.frequency_hz) > 1]
    return tuple(sorted({round(float(run.frequency_hz[1]), 2) for run in by_harmonics}))[:MOST_SPEEDS]
