"""Pictures of the errors on the check runs: by component, and by harmonic."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.reduction.result import HubLoads
from balance_cli.report.check_errors import ERROR_KINDS, ERROR_TITLES, RelativeError, harmonic_errors, pooled_errors
from balance_cli.report.figure_style import BLACK, log_limits, new_figure, set_log_axis
from balance_cli.report.sources import Source


@dataclass(frozen=True)
class MethodBars:
    """One method: its label, its color, and {kind: {component: error}}."""

    label: str
    color: str
    errors: Mapping[str, Mapping[str, RelativeError]]


def comparison_figure(methods: Sequence[Source[HubLoads]]) -> Figure:
    """Bars of every method by component: error on the left, interaction on the right; black marks: noise floor."""
    bars = [
        MethodBars(
            source.label, source.plot_style.color, {kind: pooled_errors(source.content, kind) for kind in ERROR_KINDS}
        )
        for source in methods
    ]
    return error_figure(bars, " on the check runs", height=3.6)


def error_figure(methods: Sequence[MethodBars], where: str, height: float) -> Figure:
    """Bars by component, one panel per kind of error; `where` ends the titles of the panels."""
    figure = new_figure(12.0, height)
    shown = [kind for kind in ERROR_KINDS if any(method.errors[kind] for method in methods)]
    axes = figure.subplots(1, len(shown), squeeze=False, sharey=True)[0]
    limits = _bar_limits([error for kind in shown for method in methods for error in method.errors[kind].values()])
    for ax, kind in zip(axes, shown, strict=True):
        _draw_bars(ax, methods, kind, limits)
        ax.set_title(ERROR_TITLES[kind].split(":")[0] + where)
        ax.set_ylabel(ERROR_TITLES[kind].split(": ")[1])
        ax.yaxis.set_tick_params(labelleft=True)
    handles: list[Artist] = [Patch(facecolor=method.color) for method in methods]
    handles.append(Line2D([], [], color=BLACK, linewidth=1.4))
    labels = [*(method.label for method in methods), "noise floor"]
    figure.legend(handles, labels, loc="lower center", ncols=min(len(labels), 5))
    lines = -(-len(labels) // 5)
    figure.subplots_adjust(left=0.06, right=0.99, top=0.92, bottom=0.13 + 0.055 * lines, wspace=0.13)
    return figure


def _bar_limits(errors: Sequence[RelativeError]) -> tuple[float, float]:
    values = [100 * part for error in errors for part in (error.value, error.noise)]
    return log_limits(values, 2.0, margin=1.5)


def _draw_bars(axes: Axes, methods: Sequence[MethodBars], kind: str, limits: tuple[float, float]) -> None:
    names = [name for name in COMPONENTS if any(name in method.errors[kind] for method in methods)]
    width = 0.82 / len(methods)
    set_log_axis(axes, limits)
    for i, method in enumerate(methods):
        errors = method.errors[kind]
        components = [name for name in names if name in errors]
        place = np.array([names.index(name) for name in components]) + (i - (len(methods) - 1) / 2) * width
        height = [100 * errors[name].value - limits[0] for name in components]
        axes.bar(place, height, 0.88 * width, bottom=limits[0], color=method.color, zorder=2)
        noise = [100 * errors[name].noise for name in components]
        axes.hlines(noise, place - 0.44 * width, place + 0.44 * width, colors=BLACK, linewidth=1.4, zorder=3)
    axes.set_xticks(range(len(names)), names)
    axes.tick_params(axis="x", length=0, labelsize=8)
    axes.grid(visible=False, axis="x")


def harmonic_error_figure(methods: Sequence[Source[HubLoads]]) -> Figure:
    """One panel per component: relative error of each harmonic by itself, one curve per method."""
    errors = {
        name: [(source, 100 * harmonic_errors(source.content, name)) for source in methods] for name in COMPONENTS
    }
    names = [name for name in COMPONENTS if any(len(values) for _, values in errors[name])]
    figure = new_figure(12.0, 2.7)
    panels = figure.subplots(1, len(names), squeeze=False, sharey=True)[0]
    limits = log_limits(np.concatenate([values for name in names for _, values in errors[name]]), 2.0, 1.5)
    for axes, name in zip(panels, names, strict=True):
        set_log_axis(axes, limits)
        axes.set_title(name)
        axes.set_xlabel("harmonic")
        for source, values in errors[name]:
            axes.plot(
                np.arange(1, 1 + len(values)), values, marker=source.plot_style.marker, **source.plot_style.line_kwargs
            )
        axes.set_xticks(range(1, 1 + max(len(values) for _, values in errors[name])))
    panels[0].set_ylabel("error [% of the load]")
    handles = [Line2D([], [], marker=source.plot_style.marker, **source.plot_style.line_kwargs) for source in methods]
    labels = [source.label for source in methods]
    figure.legend(handles, labels, loc="lower center", ncols=min(len(labels), 6))
    lines = -(-len(labels) // 6)
    figure.subplots_adjust(left=0.055, right=0.99, top=0.91, bottom=0.19 + 0.07 * lines, wspace=0.08)
    return figure
