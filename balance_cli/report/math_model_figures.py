"""Pictures of the residuals of the calibration model: in the order of loading, and against the varied loads."""

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

from balance_cli.calibration.all_trims_result import AllTrimsCalibration
from balance_cli.calibration.load_series import MIN_LOAD_CHANGE
from balance_cli.report.figure_style import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILION, PlotStyle, new_figure
from balance_cli.report.load_series_rows import LoadSeriesRows, channel_outliers, channel_residual_sigma
from balance_cli.report.number_format import format_percent, format_significant
from balance_cli.report.reading_scale import MICROVOLTS, ReadingScale
from balance_cli.signals import distributions as stats

Array = NDArray[np.float64]

PANEL_COLUMNS = {"order": 2, "load": 4}
PANEL_HEIGHT = {"order": 1.3, "load": 2.2}
PANEL_GAPS = {"order": (0.14, 0.34), "load": (0.2, 0.2)}
"""Columns of panels, height of a row of panels [inch], and gaps between them."""
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
"""Limit of the residual axis over the largest residual."""
TREND_DEGREE = 3
"""Degree of the curves through the residuals: that of the highest terms of the model."""
TREND_SIGNIFICANCE = 1e-3
"""P-value of the F-test below which a curve is drawn: few spurious ones among some fifty tests on a page."""
RUN_LABEL_STYLE: dict[str, Any] = {
    "xycoords": ("data", "axes fraction"),
    "textcoords": "offset points",
    "ha": "center",
    "va": "center",
    "color": "#444444",
    "fontsize": 7.5,
}
RASTERIZE_ABOVE = 4000
"""Number of points above which they are drawn as pixels, which keeps the page small."""
LETTERS_PER_INCH = 14.0
"""Letters of an axis label in an inch, at the font size of the page."""


def order_figure(
    all_trims: AllTrimsCalibration, series: Sequence[LoadSeriesRows], ranges: Array, scale: ReadingScale = MICROVOLTS
) -> Figure:
    """One panel per channel: residual in the order of loading, load series as bands; `ranges` (c,) [V]."""
    figure, panels, last = _make_panels(len(all_trims.model.channel_names), "order", scale)
    row = np.arange(1.0, len(all_trims.loads) + 1.0)
    for c, axes in enumerate(panels):
        _shade_load_series(axes, series, c)
        _set_title(axes, all_trims, c, ranges, scale)
        for sign in (-2.0 * scale.per_base_unit, 2.0 * scale.per_base_unit):
            axes.axhline(
                sign * channel_residual_sigma(all_trims)[c], color=BLACK, linewidth=0.6, linestyle=(0, (4, 3)), zorder=2
            )
        axes.plot(
            row,
            scale.per_base_unit * all_trims.residuals[:, c],
            ".",
            color=BLUE,
            markersize=3.2,
            rasterized=_is_rasterized(all_trims),
            zorder=3,
        )
        _draw_outliers(axes, all_trims, c, row[:, None], scale)
        axes.set_xlim(0.5, len(row) + 0.5)
        axes.grid(visible=False, axis="x")
    for axes in last:
        _label_order_axis(axes, all_trims, series)
    _add_legend(figure, *_order_legend_entries(all_trims, series))
    return figure


def load_figure(
    all_trims: AllTrimsCalibration, series: Sequence[LoadSeriesRows], ranges: Array, scale: ReadingScale = MICROVOLTS
) -> Figure:
    """One panel per channel: residual against the varied loads in % of the calibrated range, by component."""
    figure, panels, last = _make_panels(len(all_trims.model.channel_names), "load", scale)
    x, styles = varied_loads(all_trims, series), component_styles(all_trims.model.components)
    for c, axes in enumerate(panels):
        _set_title(axes, all_trims, c, ranges, scale)
        axes.axhline(0.0, color=BLACK, linewidth=0.6, zorder=1)
        for j, plot_style in enumerate(styles):
            _draw_component(
                axes, x[:, j], scale.per_base_unit * all_trims.residuals[:, c], plot_style, _is_rasterized(all_trims)
            )
        _draw_outliers(axes, all_trims, c, 100 * x, scale)
    for axes in last:
        axes.set_xlabel("load [% of calibrated range]")
    handles: list[Artist] = [
        Line2D([], [], marker=plot_style.marker, markersize=4, **plot_style.line_kwargs) for plot_style in styles
    ]
    _add_legend(figure, handles, list(all_trims.model.components))
    return figure


def component_styles(components: Sequence[str]) -> list[PlotStyle]:
    """The styles of components: those of the hub loads, in their order for components of other names."""
    if set(components) <= set(COMPONENT_STYLES):
        return [COMPONENT_STYLES[name] for name in components]
    return list(COMPONENT_STYLES.values())[: len(components)]


def varied_loads(all_trims: AllTrimsCalibration, series: Sequence[LoadSeriesRows]) -> Array:
    """Loads (m, k) in units of the calibrated range, NaN where a load was constant in the load series of the row."""
    x = np.full(all_trims.loads.shape, np.nan)
    for entry in series:
        at = np.ix_(entry.rows, np.array(entry.moved, dtype=np.intp))
        x[at] = (all_trims.loads / all_trims.model.calibrated_range)[at]
    return x


def fit_trend(x: Array, values: Array) -> tuple[Array, Array]:
    """Fit a polynomial of degree TREND_DEGREE: places and values of its curve, empty if it is not significant."""
    known = np.isfinite(x) & np.isfinite(values)
    dof, empty = int(np.count_nonzero(known)) - TREND_DEGREE - 1, (np.zeros(0), np.zeros(0))
    if dof < 1 or len(np.unique(np.round(x[known] / MIN_LOAD_CHANGE))) <= TREND_DEGREE + 1:
        return empty
    trend = np.polynomial.Polynomial.fit(x[known], values[known], TREND_DEGREE)
    explained = float(np.sum(trend(x[known]) ** 2))
    residual = max(float(np.sum((values[known] - trend(x[known])) ** 2)), np.finfo(float).tiny)
    if stats.f.sf(explained / (TREND_DEGREE + 1) / (residual / dof), TREND_DEGREE + 1, dof) > TREND_SIGNIFICANCE:
        return empty
    places = np.linspace(float(x[known].min()), float(x[known].max()), 60)
    return places, np.asarray(trend(places))


def _draw_component(axes: Axes, x: Array, values: Array, plot_style: PlotStyle, many: bool) -> None:
    """Draw the residuals against one component, and their trend if it is significant."""
    axes.plot(
        100 * x, values, plot_style.marker, color=plot_style.color, markersize=2.8, alpha=0.55, mew=0, rasterized=many
    )
    place, smooth = fit_trend(x, values)
    axes.plot(100 * place, smooth, color=plot_style.color, linewidth=1.4, zorder=4)


def _make_panels(count: int, kind: str, scale: ReadingScale) -> tuple[Figure, list[Axes], list[Axes]]:
    """The figure, its panels, and the panels without another one below."""
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
        axes.set_ylabel(f"residual [{scale.symbol}]")
    wide, high = PANEL_GAPS[kind]
    bottom = LEGEND_INCHES / total
    figure.subplots_adjust(left=0.06, right=0.99, top=1 - 0.22 / total, bottom=bottom, wspace=wide, hspace=high)
    return figure, panels[:count], last


def _is_rasterized(all_trims: AllTrimsCalibration) -> bool:
    return all_trims.residuals.size > RASTERIZE_ABOVE


def _set_title(axes: Axes, all_trims: AllTrimsCalibration, c: int, ranges: Array, scale: ReadingScale) -> None:
    """Set name and standard deviation of the channel as the title, and the limits of the residual axis."""
    s = float(channel_residual_sigma(all_trims)[c])
    small = (
        f"s {format_significant(scale.per_base_unit * s)} {scale.symbol}, {format_percent(s / ranges[c])} % of range"
    )
    axes.set_title(all_trims.model.channel_names[c], loc="left")
    axes.set_title(small, loc="right", fontsize=7.5, fontweight="normal", color="#555555")
    largest = float(np.nanmax(np.abs(all_trims.residuals[:, c]), initial=2.0 * s))
    limit = scale.per_base_unit * AXIS_MARGIN * largest
    axes.set_ylim(-limit, limit)


def _shade_load_series(axes: Axes, series: Sequence[LoadSeriesRows], c: int) -> None:
    """Shade every second load series, and hatch excluded ones, in a stronger color where this channel was suspect."""
    for n, entry in enumerate(series):
        if not entry.used:
            edge = VERMILION if entry.bad[c] else HATCH_COLOR
            axes.axvspan(*entry.ends, facecolor="white", edgecolor=edge, hatch="////", linewidth=0, zorder=0)
        elif n % 2:
            axes.axvspan(*entry.ends, color=SERIES_SHADE, linewidth=0, zorder=0)
        if n and entry.run != series[n - 1].run:
            axes.axvline(entry.ends[0], color=BLACK, linewidth=0.8, zorder=1)


def _draw_outliers(axes: Axes, all_trims: AllTrimsCalibration, c: int, x: Array, scale: ReadingScale) -> None:
    """Draw triangles at places x (m, n) of the excluded rows, at the edge of the panel where they lie beyond it."""
    limit = axes.get_ylim()[1]
    for row, outlier in channel_outliers(all_trims, c):
        place = x[row][np.isfinite(x[row])]
        value = float(np.clip(scale.per_base_unit * outlier.error, -0.93 * limit, 0.93 * limit))
        marker = "^" if outlier.error > 0 else "v"
        axes.plot(place, np.full(len(place), value), marker, color=VERMILION, markersize=6.5, zorder=5)
        label = f" {format_significant(scale.per_base_unit * outlier.error)}"
        for each in place:
            axes.annotate(label, (each, value), (5, 0), textcoords="offset points", fontsize=7, va="center", zorder=6)


def _label_order_axis(axes: Axes, all_trims: AllTrimsCalibration, series: Sequence[LoadSeriesRows]) -> None:
    """Label the load series by their varied loads, and the runs below; number the load points where space is short."""
    letters = LETTERS_PER_INCH * PAGE_INCHES * float(axes.get_position().width) / len(all_trims.loads)
    names = [" ".join(all_trims.model.components[j] for j in entry.moved) for entry in series]
    if any(len(name) + 1 > letters * len(entry.rows) for name, entry in zip(names, series, strict=True)):
        axes.set_xlabel("load point, in the order of loading")
        return
    axes.set_xticks([float(np.mean(entry.ends)) for entry in series], names)
    axes.tick_params(axis="x", length=0)
    for n, name in enumerate(all_trims.runs):
        rows = np.flatnonzero(all_trims.run == n)
        if len(name) + 1 <= letters * len(rows):
            axes.annotate(name, (float(np.mean(rows)) + 1.0, 0.0), (0, -22), **RUN_LABEL_STYLE)


def _order_legend_entries(
    all_trims: AllTrimsCalibration, series: Sequence[LoadSeriesRows]
) -> tuple[list[Artist], list[str]]:
    handles: list[Artist] = [
        Line2D([], [], color=BLUE, marker=".", linestyle=""),
        Line2D([], [], color=BLACK, linewidth=0.6, linestyle=(0, (4, 3))),
    ]
    labels = ["load point", "two standard deviations"]
    if all_trims.outliers:
        handles.append(Line2D([], [], color=VERMILION, marker="^", linestyle=""))
        labels.append("excluded row, with its error")
    if not all(entry.used for entry in series):
        handles += [
            Patch(facecolor="white", edgecolor=edge, hatch="////", linewidth=0) for edge in (HATCH_COLOR, VERMILION)
        ]
        labels += ["excluded load series", "suspect in this channel"]
    return handles, labels


def _add_legend(figure: Figure, handles: list[Artist], labels: list[str]) -> None:
    figure.legend(handles, labels, loc="lower center", ncols=len(labels))
