"""Hub-load error and interaction on runs with known loads, method by method."""

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
    """Check runs of all methods side by side; None without check runs."""
    methods = loads_with_check_runs(sources)
    if not methods:
        return None
    blocks: list[PageBlock] = [
        Paragraph(
            "The loads of the check runs were measured by the exciter and used in no fit. Error: rms of reduced minus "
            "applied over rms of applied loads, complex amplitudes of harmonics 1 to 8. Interaction: reduced loads in "
            "components that were not applied, relative to the largest applied force (moments: to that force times the "
            "height of the hub). In small print: the noise floor, the error that the noise of the records alone causes."
        ),
        overview_table(methods),
        Picture(
            "check-runs",
            "Error and interaction by component, rms over the check runs; black marks: noise floor.",
            svg(
                "check-runs",
                "Hub-load error and interaction of each method by component",
                lambda: comparison_figure(methods),
            ),
        ),
        Picture(
            "check-harmonics",
            "Error of every harmonic by itself, rms over the check runs in which the component was applied.",
            svg(
                "check-harmonics",
                "Hub-load error of each method by harmonic",
                lambda: harmonic_error_figure(methods),
            ),
        ),
        Details("Each check run", tuple(_run_tables(methods))),
    ]
    return Section("check-runs", "Check runs: errors of the hub loads", tuple(blocks))


def overview_table(methods: Sequence[Source[HubLoads]]) -> Table:
    """Components down, methods across: errors pooled over the check runs, and over all components."""
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
        f"Percent, rms over {count} check run{'s' if count > 1 else ''}; small: noise floor. "
        "Bold: the smallest of its row. Shaded: within twice the noise floor."
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
    run_names = dict.fromkeys(name for source in methods for name in check_runs(source.content))
    for run_name in run_names:
        runs = [check_runs(source.content).get(run_name) for source in methods]
        rows: list[Row] = []
        for kind in ERROR_KINDS:
            errors = [run_errors(run, kind) if run else {} for run in runs]
            components = [name for name in COMPONENTS if any(name in run_error for run_error in errors)]
            if components:
                rows.append(group_heading_row(ERROR_TITLES[kind], 1 + len(methods)))
            rows += [_error_row(name, [run_error.get(name) for run_error in errors]) for name in components]
        first = next(run for run in runs if run is not None)
        caption = f"{run_name}: {_interval_text(first)}, {_speed_text(first)}. Percent."
        yield Table(caption, (_method_header(methods),), tuple(rows))


def _interval_text(run: RunLoads) -> str:
    return f"{run.interval[0]:.2f} to {run.interval[1]:.2f} s of the record"


def _speed_text(run: RunLoads) -> str:
    return f"1/rev at {run.frequency_hz[1]:.3f} Hz" if len(run.frequency_hz) > 1 else "no harmonics"
