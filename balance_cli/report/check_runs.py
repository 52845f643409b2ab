"""The table that matters: hub-load error and interaction on runs whose loads are known, method by method."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.reduction.result import HubLoads, RunLoads
from balance_cli.report.blocks import (
    Details,
    PageBlock,
    Paragraph,
    Picture,
    Row,
    Section,
    Table,
    TableCell,
    group_heading_row,
)
from balance_cli.report.check_errors import (
    ERROR_KINDS,
    ERROR_TITLES,
    RelativeError,
    check_runs,
    loads_with_check_runs,
    overall_error,
    pooled_errors,
    run_errors,
)
from balance_cli.report.check_figures import comparison_figure, harmonic_error_figure
from balance_cli.report.figure_style import svg
from balance_cli.report.number_format import format_percent
from balance_cli.report.sources import Source, Sources


def section(sources: Sources) -> Section | None:
    """Check runs of all methods side by side; None where there are none."""
    methods = loads_with_check_runs(sources)
    if not methods:
        return None
    blocks: list[PageBlock] = [
        Paragraph(
            "Loads of the check runs were measured by the exciter and kept out of every fit. Error: rms of reduced "
            "less applied over rms of applied, complex amplitudes of harmonics 1 to 8. Interaction: what is found of "
            "components that were not applied, relative to the largest applied force (moments: over the height of the "
            "hub times that force). Beside each figure, small: what the noise of the records alone would leave."
        ),
        overview_table(methods),
        Picture(
            "check-runs",
            "Error and interaction by component, rms over the check runs; black marks: what noise alone would leave.",
            svg(
                "check-runs",
                "Hub-load error and interaction of each method by component",
                lambda: comparison_figure(methods),
            ),
        ),
        Picture(
            "check-harmonics",
            "Where the error comes from: every harmonic by itself, rms over the check runs that applied the component.",
            svg(
                "check-harmonics",
                "Hub-load error of each method by harmonic",
                lambda: harmonic_error_figure(methods),
            ),
        ),
        Details("Every check run by itself", tuple(_run_tables(methods))),
    ]
    return Section("check-runs", "Check runs: how wrong the hub loads are", tuple(blocks))


def overview_table(methods: Sequence[Source[HubLoads]]) -> Table:
    """Components down, methods across, pooled over the check runs, and all components together."""
    rows: list[Row] = []
    for kind in ERROR_KINDS:
        pooled = [pooled_errors(source.content, kind) for source in methods]
        names = [name for name in COMPONENTS if any(name in errors for errors in pooled)]
        if not names:
            continue
        rows.append(group_heading_row(ERROR_TITLES[kind], 1 + len(methods)))
        rows += [_error_row(name, [errors.get(name) for errors in pooled]) for name in names]
        rows.append(_error_row("all, rms", [overall_error(source.content, kind) for source in methods], "total"))
    count = max(len(check_runs(source.content)) for source in methods)
    caption = (
        f"Percent, rms over {count} check run{'s' if count > 1 else ''}; small: what noise alone would leave. "
        "Bold: the least of its row. Shaded: within twice the noise."
    )
    return Table(caption, (_method_header(methods),), tuple(rows))


def _method_header(methods: Sequence[Source[HubLoads]]) -> Row:
    return (TableCell(""), *(TableCell(source.label, title=source.file) for source in methods))


def _error_row(name: str, errors: Sequence[RelativeError | None], mark: str = "") -> Row:
    least = min((error.value for error in errors if error is not None), default=float("nan"))
    return (TableCell(name, mark=f"name {mark}"), *(_error_cell(error, least, mark) for error in errors))


def _error_cell(error: RelativeError | None, least: float, mark: str) -> TableCell:
    if error is None:
        return TableCell("")
    marks = [mark, "best" if error.value == least else "", "good" if error.is_noise else ""]
    return TableCell(format_percent(error.value), format_percent(error.noise), " ".join(filter(None, marks)))


def _run_tables(methods: Sequence[Source[HubLoads]]) -> Iterator[Table]:
    names = dict.fromkeys(name for source in methods for name in check_runs(source.content))
    for name in names:
        runs = [check_runs(source.content).get(name) for source in methods]
        rows: list[Row] = []
        for kind in ERROR_KINDS:
            errors = [run_errors(run, kind) if run else {} for run in runs]
            components = [component for component in COMPONENTS if any(component in each for each in errors)]
            if components:
                rows.append(group_heading_row(ERROR_TITLES[kind], 1 + len(methods)))
            rows += [_error_row(component, [each.get(component) for each in errors]) for component in components]
        first = next(run for run in runs if run is not None)
        caption = f"{name}: {_interval_text(first)}, {_speed_text(first)}. Percent."
        yield Table(caption, (_method_header(methods),), tuple(rows))


def _interval_text(run: RunLoads) -> str:
    return f"{run.interval[0]:.2f} to {run.interval[1]:.2f} s of the record"


def _speed_text(run: RunLoads) -> str:
    return f"1/rev at {run.frequency_hz[1]:.3f} Hz" if len(run.frequency_hz) > 1 else "no harmonics"
