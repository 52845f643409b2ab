"""The table that matters: hub-load error and interaction on runs whose loads are known, method by method."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from balance_cli.components import COMPONENTS
from balance_cli.hub_loads import Loads, RunLoads
from balance_cli.report.blocks import Block, Cell, Details, Picture, Row, Section, Table, Text, group_row
from balance_cli.report.drawing import BLACK, decades, new_figure, plain_log, svg
from balance_cli.report.numbers import percent
from balance_cli.report.sources import Source, Sources

NEAR_NOISE = 2.0
"""An error up to so many times what noise alone leaves counts as noise."""
KINDS = ("load_error", "interaction")
TITLES = {
    "load_error": "Hub-load error: % of the load applied",
    "interaction": "Interaction: % of the largest force applied",
}


@dataclass(frozen=True)
class Error:
    """An error relative to the applied loads, and what the noise alone would leave of it."""

    value: float
    noise: float

    @property
    def is_noise(self) -> bool:
        """Whether it is hardly more than noise."""
        return self.value <= NEAR_NOISE * self.noise


def check_runs(loads: Loads) -> dict[str, RunLoads]:
    """The runs with known loads."""
    return {name: run for name, run in loads.runs.items() if run.check is not None}


def run_errors(run: RunLoads, kind: str) -> dict[str, Error]:
    """{component: error} of one check run; `kind` is `load_error` or `interaction`."""
    assert run.check is not None
    values: dict[str, float] = getattr(run.check, kind)
    noise = run.check.load_noise if kind == "load_error" else run.check.interaction_noise
    return {name: Error(value, noise.get(name, float("nan"))) for name, value in values.items()}


def pooled_errors(loads: Loads, kind: str) -> dict[str, Error]:
    """{component: rms over the check runs that have it}, in the order of the components."""
    runs = [run_errors(run, kind) for run in check_runs(loads).values()]
    return {
        name: rms_error([errors[name] for errors in runs if name in errors])
        for name in COMPONENTS
        if any(name in errors for errors in runs)
    }


def rms_error(errors: Sequence[Error]) -> Error:
    """Root mean square of errors, and of what noise leaves."""
    values, noise = ([getattr(error, part) for error in errors] for part in ("value", "noise"))
    return Error(float(np.sqrt(np.mean(np.square(values)))), float(np.sqrt(np.mean(np.square(noise)))))


def overall_error(loads: Loads, kind: str) -> Error | None:
    """Rms over all components of all check runs; None where there is none."""
    errors = [error for run in check_runs(loads).values() for error in run_errors(run, kind).values()]
    return rms_error(errors) if errors else None


def checked(sources: Sources) -> tuple[Source[Loads], ...]:
    """The loads that hold check runs."""
    return tuple(source for source in sources.loads if check_runs(source.content))


def section(sources: Sources) -> Section | None:
    """Check runs of all methods side by side; None where there are none."""
    methods = checked(sources)
    if not methods:
        return None
    blocks: list[Block] = [
        Text(
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
        Details("Every check run by itself", tuple(_run_tables(methods))),
    ]
    return Section("check-runs", "Check runs: how wrong the hub loads are", tuple(blocks))


def overview_table(methods: Sequence[Source[Loads]]) -> Table:
    """Components down, methods across, pooled over the check runs, and all components together."""
    rows: list[Row] = []
    for kind in KINDS:
        pooled = [pooled_errors(source.content, kind) for source in methods]
        names = [name for name in COMPONENTS if any(name in errors for errors in pooled)]
        if not names:
            continue
        rows.append(group_row(TITLES[kind], 1 + len(methods)))
        rows += [_error_row(name, [errors.get(name) for errors in pooled]) for name in names]
        rows.append(_error_row("all, rms", [overall_error(source.content, kind) for source in methods], "total"))
    count = max(len(check_runs(source.content)) for source in methods)
    caption = (
        f"Percent, rms over {count} check run{'s' if count > 1 else ''}; small: what noise alone would leave. "
        "Bold: the least of its row. Shaded: within twice the noise."
    )
    return Table(caption, (_heads(methods),), tuple(rows))


def _heads(methods: Sequence[Source[Loads]]) -> Row:
    return (Cell(""), *(Cell(source.label, title=source.file) for source in methods))


def _error_row(name: str, errors: Sequence[Error | None], mark: str = "") -> Row:
    least = min((error.value for error in errors if error is not None), default=float("nan"))
    return (Cell(name, mark=f"name {mark}"), *(_error_cell(error, least, mark) for error in errors))


def _error_cell(error: Error | None, least: float, mark: str) -> Cell:
    if error is None:
        return Cell("")
    marks = [mark, "best" if error.value == least else "", "good" if error.is_noise else ""]
    return Cell(percent(error.value), percent(error.noise), " ".join(filter(None, marks)))


def _run_tables(methods: Sequence[Source[Loads]]) -> Iterator[Table]:
    names = dict.fromkeys(name for source in methods for name in check_runs(source.content))
    for name in names:
        runs = [check_runs(source.content).get(name) for source in methods]
        rows: list[Row] = []
        for kind in KINDS:
            errors = [run_errors(run, kind) if run else {} for run in runs]
            components = [component for component in COMPONENTS if any(component in each for each in errors)]
            if components:
                rows.append(group_row(TITLES[kind], 1 + len(methods)))
            rows += [_error_row(component, [each.get(component) for each in errors]) for component in components]
        first = next(run for run in runs if run is not None)
        caption = f"{name}: {_interval(first)}, {_speed(first)}. Percent."
        yield Table(caption, (_heads(methods),), tuple(rows))


def _interval(run: RunLoads) -> str:
    return f"{run.interval[0]:.2f} to {run.interval[1]:.2f} s of the record"


def _speed(run: RunLoads) -> str:
    return f"1/rev at {run.frequency_hz[1]:.3f} Hz" if len(run.frequency_hz) > 1 else "no harmonics"


def comparison_figure(methods: Sequence[Source[Loads]], width: float = 12.0, height: float = 3.6) -> Figure:
    """Bars of every method by component: error on the left, interaction on the right; black marks for the noise."""
    figure = new_figure(width, height)
    pooled = {kind: [pooled_errors(source.content, kind) for source in methods] for kind in KINDS}
    shown = [kind for kind in KINDS if any(pooled[kind])]
    axes = figure.subplots(1, len(shown), squeeze=False, sharey=True)[0]
    limits = _limits([error for kind in shown for errors in pooled[kind] for error in errors.values()])
    for one, kind in zip(axes, shown, strict=True):
        _bars(one, methods, pooled[kind], limits)
        one.set_title(TITLES[kind].split(":")[0] + " on the check runs")
        one.set_ylabel(TITLES[kind].split(": ")[1])
        one.yaxis.set_tick_params(labelleft=True)
    handles: list[Artist] = [Patch(facecolor=source.look.colour) for source in methods]
    handles.append(Line2D([], [], color=BLACK, linewidth=1.4))
    labels = [*(source.label for source in methods), "what noise alone would leave"]
    figure.legend(handles, labels, loc="lower center", ncols=min(len(labels), 5))
    lines = -(-len(labels) // 5)
    figure.subplots_adjust(left=0.06, right=0.99, top=0.92, bottom=0.13 + 0.055 * lines, wspace=0.13)
    return figure


def _limits(errors: Sequence[Error]) -> tuple[float, float]:
    values = [100 * part for error in errors for part in (error.value, error.noise)]
    return decades(values, 2.0, margin=1.5)


def _bars(
    axes: Axes, methods: Sequence[Source[Loads]], pooled: Sequence[dict[str, Error]], limits: tuple[float, float]
) -> None:
    names = [name for name in COMPONENTS if any(name in errors for errors in pooled)]
    width = 0.82 / len(methods)
    plain_log(axes, limits)
    for i, (source, errors) in enumerate(zip(methods, pooled, strict=True)):
        mine = [name for name in names if name in errors]
        place = np.array([names.index(name) for name in mine]) + (i - (len(methods) - 1) / 2) * width
        height = [100 * errors[name].value - limits[0] for name in mine]
        axes.bar(place, height, 0.88 * width, bottom=limits[0], color=source.look.colour, zorder=2)
        noise = [100 * errors[name].noise for name in mine]
        axes.hlines(noise, place - 0.44 * width, place + 0.44 * width, colors=BLACK, linewidth=1.4, zorder=3)
    axes.set_xticks(range(len(names)), names)
    axes.tick_params(axis="x", length=0, labelsize=8)
    axes.grid(visible=False, axis="x")
