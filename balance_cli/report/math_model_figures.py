"""Pictures of what the gage model leaves: residuals in the order of loading, and against the load that moved."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray
from scipy import stats

from balance_cli.calibration.all_trims import AllTrimsCalibration
from balance_cli.calibration.load_series import MIN_LOAD_CHANGE
from balance_cli.report.figure_style import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILION, PlotStyle, new_figure
from balance_cli.report.load_series_rows import LoadSeriesRows, channel_outliers, channel_residual_sigma
from balance_cli.report.number_format import format_percent, format_significant

Array = NDArray[np.float64]

PANEL_COLUMNS = {"order": 2, "load": 4}
PANEL_HEIGHT = {"order": 1.3, "load": 2.2}
PANEL_GAPS = {"order": (0.14, 0.34), "load": (0.2, 0.2)}
"""Columns of panels, height of a line of them [inch], and gaps between them."""
PAGE_INCHES, LEGEND_INCHES = 12.0, 0.75
COMPONENT_STYLES = {
    "Fx": PlotStyle(BLUE, (), "o"),
    "Fy": PlotStyle(ORANGE, (), "s"),
    "Fz": PlotStyle(GREEN, (), "D"),
    "Mx": PlotStyle(VERMILION, (), "^"),
    "My": PlotStyle(PURPLE, (), "v"),
    "Mz": PlotStyle(SKY, (), "P"),
}
SERIES_SHADE, HATCH_COLOR = "#f0f2f4", "#e3b79b"
AXIS_MARGIN = 1.15
"""Limit of an axis over the largest residual."""
TREND_DEGREE = 3
"""Degree of the smooth lines through the residuals."""
TREND_SIGNIFICANCE = 1e-3
"""Probability of a line where nothing is left."""
RUN_LABEL_STYLE: dict[str, Any] = {
    "xycoords": ("data", "axes fraction"),
    "textcoords": "offset points",
    "ha": "center",
    "va": "center",
    "color": "#444444",
    "fontsize": 7.5,
}
RASTERIZE_ABOVE = 4000
"""More points than these are drawn as pixels."""
LETTERS_PER_INCH = 14.0


def order_figure(gage: AllTrimsCalibration, known: Sequence[LoadSeriesRows], ranges: Array) -> Figure:
    """One panel a channel: residual [uV] in the order of loading, sequences as bands; `ranges` (c,) [V]."""
    figure, panels, last = _make_panels(len(gage.model.channel_names), "order")
    row = np.arange(1.0, len(gage.loads) + 1.0)
    for c, axes in enumerate(panels):
        _shade_load_series(axes, known, c)
        _set_title(axes, gage, c, ranges)
        for sign in (-2e6, 2e6):
            axes.axhline(
                sign * channel_residual_sigma(gage)[c], color=BLACK, linewidth=0.6, linestyle=(0, (4, 3)), zorder=2
            )
        axes.plot(
            row, 1e6 * gage.residuals[:, c], ".", color=BLUE, markersize=3.2, rasterized=_is_rasterized(gage), zorder=3
        )
        _draw_outliers(axes, gage, c, row[:, None])
        axes.set_xlim(0.5, len(row) + 0.5)
        axes.grid(visible=False, axis="x")
    for axes in last:
        _label_order_axis(axes, gage, known)
    _add_legend(figure, *_order_legend_entries(gage, known))
    return figure


def load_figure(gage: AllTrimsCalibration, known: Sequence[LoadSeriesRows], ranges: Array) -> Figure:
    """One panel a channel: residual [uV] against the loads that moved, % of full range, one colour a component."""
    figure, panels, last = _make_panels(len(gage.model.channel_names), "load")
    x, looks = varied_loads(gage, known), [COMPONENT_STYLES[name] for name in gage.model.components]
    for c, axes in enumerate(panels):
        _set_title(axes, gage, c, ranges)
        axes.axhline(0.0, color=BLACK, linewidth=0.6, zorder=1)
        for j, plot_style in enumerate(looks):
            _draw_component(axes, x[:, j], 1e6 * gage.residuals[:, c], plot_style, _is_rasterized(gage))
        _draw_outliers(axes, gage, c, 100 * x)
    for axes in last:
        axes.set_xlabel("load [% of full range]")
    handles: list[Artist] = [
        Line2D([], [], marker=plot_style.marker, markersize=4, **plot_style.line_kwargs) for plot_style in looks
    ]
    _add_legend(figure, handles, list(gage.model.components))
    return figure


def varied_loads(gage: AllTrimsCalibration, known: Sequence[LoadSeriesRows]) -> Array:
    """Loads (m, k) over full range, NaN but for those that moved in the sequence of their row."""
    x = np.full(gage.loads.shape, np.nan)
    for one in known:
        at = np.ix_(one.rows, np.array(one.moved, dtype=np.intp))
        x[at] = (gage.loads / gage.model.full_range)[at]
    return x


def fit_trend(x: Array, values: Array) -> tuple[Array, Array]:
    """A polynomial of degree TREND through values over x: places and values; empty where chance makes one as large."""
    known = np.isfinite(x) & np.isfinite(values)
    dof, empty = int(np.count_nonzero(known)) - TREND_DEGREE - 1, (np.zeros(0), np.zeros(0))
    if dof < 1 or len(np.unique(np.round(x[known] / MIN_LOAD_CHANGE))) <= TREND_DEGREE + 1:
        return empty
    found = np.polynomial.Polynomial.fit(x[known], values[known], TREND_DEGREE)
    explained = float(np.sum(found(x[known]) ** 2))
    left = max(float(np.sum((values[known] - found(x[known])) ** 2)), np.finfo(float).tiny)
    if stats.f.sf(explained / (TREND_DEGREE + 1) / (left / dof), TREND_DEGREE + 1, dof) > TREND_SIGNIFICANCE:
        return empty
    places = np.linspace(float(x[known].min()), float(x[known].max()), 60)
    return places, np.asarray(found(places))


def _draw_component(axes: Axes, x: Array, values: Array, plot_style: PlotStyle, many: bool) -> None:
    """Rows of one component, and the smooth line that is left in them."""
    axes.plot(
        100 * x, values, plot_style.marker, color=plot_style.colour, markersize=2.8, alpha=0.55, mew=0, rasterized=many
    )
    place, smooth = fit_trend(x, values)
    axes.plot(100 * place, smooth, color=plot_style.colour, linewidth=1.4, zorder=4)


def _make_panels(count: int, kind: str) -> tuple[Figure, list[Axes], list[Axes]]:
    """The figure, its panels, and those with nothing below them."""
    columns = min(PANEL_COLUMNS[kind], count)
    lines = -(-count // columns)
    total = PANEL_HEIGHT[kind] * lines + LEGEND_INCHES + 0.25
    figure = new_figure(PAGE_INCHES, total)
    panels = figure.subplots(lines, columns, squeeze=False, sharex=True).ravel().tolist()
    for axes in panels[count:]:
        axes.set_axis_off()
    last = panels[max(count - columns, 0) : count]
    for axes in last:
        axes.tick_params(axis="x", labelbottom=True)
    for axes in panels[:count:columns]:
        axes.set_ylabel("residual [\N{MICRO SIGN}V]")
    wide, high = PANEL_GAPS[kind]
    bottom = LEGEND_INCHES / total
    figure.subplots_adjust(left=0.06, right=0.99, top=1 - 0.22 / total, bottom=bottom, wspace=wide, hspace=high)
    return figure, panels[:count], last


def _is_rasterized(gage: AllTrimsCalibration) -> bool:
    return gage.residuals.size > RASTERIZE_ABOVE


def _set_title(axes: Axes, gage: AllTrimsCalibration, c: int, ranges: Array) -> None:
    """Name and standard deviation, and the axis of the residuals."""
    s = float(channel_residual_sigma(gage)[c])
    small = f"s {format_significant(1e6 * s)} \N{MICRO SIGN}V, {format_percent(s / ranges[c])} % of range"
    axes.set_title(gage.model.channel_names[c], loc="left")
    axes.set_title(small, loc="right", fontsize=7.5, fontweight="normal", color="#555555")
    largest = float(np.nanmax(np.abs(gage.residuals[:, c]), initial=2.0 * s))
    axes.set_ylim(-1e6 * AXIS_MARGIN * largest, 1e6 * AXIS_MARGIN * largest)


def _shade_load_series(axes: Axes, known: Sequence[LoadSeriesRows], c: int) -> None:
    """Every second sequence shaded; hatched what took no part, more strongly where this channel was bad."""
    for n, one in enumerate(known):
        if not one.used:
            edge = VERMILION if one.bad[c] else HATCH_COLOR
            axes.axvspan(*one.ends, facecolor="white", edgecolor=edge, hatch="////", linewidth=0, zorder=0)
        elif n % 2:
            axes.axvspan(*one.ends, color=SERIES_SHADE, linewidth=0, zorder=0)
        if n and one.run != known[n - 1].run:
            axes.axvline(one.ends[0], color=BLACK, linewidth=0.8, zorder=1)


def _draw_outliers(axes: Axes, gage: AllTrimsCalibration, c: int, x: Array) -> None:
    """Triangles at places x (m, n) of the rows that took no part, at the edge where they lie beyond it."""
    limit = axes.get_ylim()[1]
    for row, one in channel_outliers(gage, c):
        place = x[row][np.isfinite(x[row])]
        value = float(np.clip(1e6 * one.error, -0.93 * limit, 0.93 * limit))
        marker = "^" if one.error > 0 else "v"
        axes.plot(place, np.full(len(place), value), marker, color=VERMILION, markersize=6.5, zorder=5)
        words = f" {format_significant(1e6 * one.error)}"
        for each in place:
            axes.annotate(words, (each, value), (5, 0), textcoords="offset points", fontsize=7, va="center", zorder=6)


def _label_order_axis(axes: Axes, gage: AllTrimsCalibration, known: Sequence[LoadSeriesRows]) -> None:
    """Sequences by the loads that moved, runs below them; load points where the names have no room."""
    letters = LETTERS_PER_INCH * PAGE_INCHES * float(axes.get_position().width) / len(gage.loads)
    names = [" ".join(gage.model.components[j] for j in one.moved) for one in known]
    if any(len(name) + 1 > letters * len(one.rows) for name, one in zip(names, known, strict=True)):
        axes.set_xlabel("load point, in the order of loading")
        return
    axes.set_xticks([float(np.mean(one.ends)) for one in known], names)
    axes.tick_params(axis="x", length=0)
    for n, name in enumerate(gage.runs):
        rows = np.flatnonzero(gage.run == n)
        if len(name) + 1 <= letters * len(rows):
            axes.annotate(name, (float(np.mean(rows)) + 1.0, 0.0), (0, -22), **RUN_LABEL_STYLE)


def _order_legend_entries(gage: AllTrimsCalibration, known: Sequence[LoadSeriesRows]) -> tuple[list[Artist], list[str]]:
    handles: list[Artist] = [
        Line2D([], [], color=BLUE, marker=".", linestyle=""),
        Line2D([], [], color=BLACK, linewidth=0.6, linestyle=(0, (4, 3))),
    ]
    labels = ["load point", "two standard deviations"]
    if gage.outliers:
        handles.append(Line2D([], [], color=VERMILION, marker="^", linestyle=""))
        labels.append("row that took no part, with its error")
    if not all(one.used for one in known):
        handles += [
            Patch(facecolor="white", edgecolor=edge, hatch="////", linewidth=0) for edge in (HATCH_COLOR, VERMILION)
        ]
        labels += ["sequence that took no part", "bad in this channel"]
    return handles, labels


def _add_legend(figure: Figure, handles: list[Artist], labels: list[str]) -> None:
    figure.legend(handles, labels, loc="lower center", ncols=len(labels))
