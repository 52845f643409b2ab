"""Sources with few runs, for the sections that show every run in full."""

from __future__ import annotations

from dataclasses import replace

from balance_cli.reduction.result import HubLoads
from balance_cli.reduction.run_verdict import DO_NOT_USE, WITH_CARE, run_verdict
from balance_cli.report.load_figures import wind_runs
from balance_cli.report.recommendation import rank_methods
from balance_cli.report.sources import Source, Sources

MOST_RUNS = 24
"""Wind-on runs that are shown in full; each adds about 40 kB to the page."""
RUNS_SHOWN = 12
"""Runs that are shown in full where there are more."""
ORDER = (DO_NOT_USE, WITH_CARE)


def condense(sources: Sources) -> tuple[Sources, str]:
    """Return the sources with at most MOST_RUNS wind-on runs, and a sentence about what was left out (or nothing).

    The runs with the worst verdicts are kept.
    """
    names = list(dict.fromkeys(name for source in sources.loads for name in wind_runs(source.content)))
    if len(names) <= MOST_RUNS:
        return sources, ""
    verdicts = {
        name: run_verdict(run).word
        for source in reversed(rank_methods(sources.loads))
        for name, run in wind_runs(source.content).items()
    }
    worst = sorted(names, key=lambda name: ORDER.index(verdicts[name]) if verdicts[name] in ORDER else len(ORDER))
    subset = set(worst[:RUNS_SHOWN])
    loads = tuple(_with_runs(source, subset) for source in sources.loads)
    words = (
        f"Shown are {len(subset)} of {len(names)} runs, those with the worst verdicts first. All runs are in the index "
        "above; balance report --run NAME makes the page of a run."
    )
    return replace(sources, loads=tuple(source for source in loads if source.content.runs)), words


def with_runs(sources: Sources, names: set[str]) -> Sources:
    """Return the sources with only these runs of their loads, and only these run files."""
    loads = tuple(
        replace(source, content=replace(source.content, runs=runs))
        for source in sources.loads
        if (runs := {name: run for name, run in source.content.runs.items() if name in names})
    )
    return replace(sources, loads=loads, runs=tuple(run for run in sources.runs if run.name in names))


def _with_runs(source: Source[HubLoads], names: set[str]) -> Source[HubLoads]:
    runs = {name: run for name, run in source.content.runs.items() if run.check is not None or name in names}
    return replace(source, content=replace(source.content, runs=runs))
