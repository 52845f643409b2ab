"""Verdicts, flags and warnings of the loads of every run and method, and the key figure of the residual test."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from balance_cli.io.run_messages import message_lines, messages_of_runs
from balance_cli.reduction.result import HubLoads, RunLoads
from balance_cli.reduction.run_verdict import DO_NOT_USE, USE, run_verdict, untested_loads
from balance_cli.report.blocks import Details, PageBlock, Row, Table, TableCell, WarningText
from balance_cli.report.load_figures import wind_runs
from balance_cli.report.number_format import join_names
from balance_cli.report.recommendation import rank_methods, tested_harmonics
from balance_cli.report.sources import Source
from balance_cli.report.wind_on import harmonics_above_limit

MARKS = {USE: "good", DO_NOT_USE: "bad"}
MOST_WARNINGS = 8
"""Warnings of the reduction that are shown, those that many runs have as one; the summary of the command has all."""


def verdict_blocks(sources: Sequence[Source[HubLoads]]) -> Iterator[PageBlock]:
    """Yield the warnings of the reductions, then the verdict on every run: recommended loads, then the others."""
    if not sources:
        return
    shown = rank_methods(sources)[0]
    for source in sources:
        texts = source.content.warnings or ()
        warnings = tuple(message_lines(messages_of_runs(texts, source.content.runs.keys())))
        left = len(warnings) - MOST_WARNINGS
        more = (f"{left} more",) if left > 0 else ()
        if warnings:
            yield WarningText(f"Warnings of {source.label}: {'; '.join((*warnings[:MOST_WARNINGS], *more))}.")
    yield Details("Flags and verdict of each run shown", (_verdict_table(shown),))
    others = tuple(_verdict_table(source) for source in sources if source is not shown)
    if others:
        yield Details("Verdicts on the loads by other methods", others)


def _verdict_table(source: Source[HubLoads]) -> Table:
    head = (tuple(TableCell(word, mark="text") for word in ("run", "flags", "verdict")),)
    return Table(f"Loads by {source.label}.", head, tuple(_verdict_row(run) for run in source.content.runs.values()))


def _verdict_row(run: RunLoads) -> Row:
    verdict = run_verdict(run)
    flags = ", ".join(f"{flag} ({count})" for flag, count in run.flag_counts.items()) or "none"
    return (
        TableCell(run.run, run.kind, "name"),
        TableCell(flags, mark="text"),
        TableCell(verdict.sentence, mark=f"text {MARKS.get(verdict.word, '')}".strip()),
    )


def residual_test_figure(sources: Sequence[Source[HubLoads]]) -> Iterator[tuple[str, str, str]]:
    """Yield the key figure of the residual test of wind-on runs; untested harmonics are never shown as passed."""
    with_wind = [source for source in sources if wind_runs(source.content)]
    if not with_wind:
        return
    shown = rank_methods(with_wind)[0]
    runs = wind_runs(shown.content).values()
    tested = sum(map(tested_harmonics, runs))
    failing = sum(len(harmonics_above_limit(run)) for run in runs)
    rows = sum(len(run.redundancy) for run in runs)
    if not tested and not failing:
        yield "not tested", f"wind-on harmonics ({rows}) have no redundant sensor, {shown.label}", ""
        return
    mark = "bad" if failing else "good" if tested == rows else ""
    caption = f"wind-on harmonics that fail the residual test, {shown.label}"
    if tested < rows:
        caption += f"; {rows - tested} not tested"
    loads = list(dict.fromkeys(load for run in runs for load in untested_loads(run)))
    if loads:
        caption += f"; untested: {join_names(loads)}"
    yield f"{failing} of {tested}", caption, mark
