"""Back-calculated load residuals on the page: the table and the picture with which balance reports open."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from balance_cli.calibration.all_trims_result import CheckLoads
from balance_cli.calibration.load_residuals import LoadResiduals, load_residuals
from balance_cli.calibration.result import Calibration
from balance_cli.campaign.rig.load_components import component_units, full_scale
from balance_cli.report.blocks import Details, Heading, PageBlock, Picture, Table, TableCell, plain_row, row_with_name
from balance_cli.report.figure_style import BLACK, BLUE, VERMILION, new_figure, svg
from balance_cli.report.load_series_rows import LoadSeriesRows, split_load_series
from balance_cli.report.number_format import MISSING_VALUE, format_significant

Array = NDArray[np.float64]

PAGE_INCHES, PANEL_INCHES, LABEL_INCHES = 12.0, 1.25, 0.5
COLUMNS = 2
BAND = "#f0f2f4"
AXIS_MARGIN = 1.15
"""Limit of the residual axis over the largest residual."""
RASTERIZE_ABOVE = 4000
"""Number of points above which they are drawn as pixels, which keeps the page small."""


def load_residual_blocks(calibration: Calibration, suffix: str) -> Iterator[PageBlock]:
    """Table, picture and load series of the residuals; nothing without rows. `suffix` makes names unique."""
    residuals = load_residuals(calibration)
    if residuals is None:
        return
    assert calibration.all_trims is not None
    series = split_load_series(calibration.all_trims)
    yield Heading("Back-calculated load residuals")
    yield statistics_table(residuals, component_units(calibration.geometry))
    name = f"calibration-loads{suffix}"
    caption = (
        f"Computed less applied load of each point in % of the {residuals.full_scale.meaning}, by the "
        f"{residuals.method}; the bands are the load series. Dashed: two standard deviations. Excluded rows are "
        "left out."
    )
    yield Picture(
        name, caption, svg(name, "Back-calculated load residuals", lambda: residual_figure(residuals, series))
    )
    yield Details("Residuals of each load series", (series_table(residuals, series),))


def check_load_blocks(calibration: Calibration, suffix: str) -> Iterator[PageBlock]:
    """Pictures of the check loads, point by point with their prediction intervals."""
    all_trims = calibration.all_trims
    for n, check in enumerate(all_trims.checks if all_trims is not None else ()):
        assert all_trims is not None
        model = all_trims.model
        scale = full_scale(calibration.geometry, model.components, model.calibrated_range)
        name = f"calibration-check-{n + 1}{suffix}"
        interval = "with its 95 % prediction interval; red: outside of it"
        if not np.isfinite(check.prediction_interval[check.is_valid]).any():
            interval = "whose prediction interval is not known"
        caption = (
            f"Check loads of {check.label}: computed less applied load of each point in % of the {scale.meaning}, "
            f"{interval}. Points for which the model is not valid are left out."
        )
        draw = partial(check_figure, check, model.components, scale.values)
        yield Picture(name, caption, svg(name, f"Check loads of {check.label}", draw))


def check_figure(check: CheckLoads, components: tuple[str, ...], scale: Array) -> Figure:
    """One panel per component: error of each check load with its prediction interval [% of full scale]."""
    error, interval = (100.0 * values / scale for values in (check.computed - check.applied, check.prediction_interval))
    figure, panels = _make_panels(len(components), "check load, in the order of loading")
    number = np.arange(1, len(error) + 1)
    for j, axes in enumerate(panels):
        valid = check.is_valid & np.isfinite(interval[:, j])
        outside = valid & (np.abs(error[:, j]) > interval[:, j])
        axes.axhline(0.0, color=BLACK, linewidth=0.5, zorder=1)
        for rows, color in ((valid & ~outside, BLUE), (outside, VERMILION)):
            bars = interval[rows, j]
            axes.errorbar(number[rows], error[rows, j], bars, fmt=".", color=color, markersize=3.5, linewidth=0.6)
        axes.set_title(components[j], loc="left")
        text = f"{np.count_nonzero(outside)} of {np.count_nonzero(valid)} outside"
        axes.set_title(text, loc="right", fontsize=7.5, fontweight="normal", color="#555555")
        axes.set_xlim(0.5, len(error) + 0.5)
    return figure


def statistics_table(residuals: LoadResiduals, units: dict[str, str]) -> Table:
    """Full scale, standard deviation, two sigma and largest residual of each component."""
    words = ("component", "full scale", "standard deviation", "two sigma", "largest", "at")
    largest, at = residuals.largest
    rows = []
    for j, name in enumerate(residuals.components):
        kind = "rated" if residuals.full_scale.is_rated[j] else "calibrated"
        sigma, full = float(residuals.standard_deviation[j]), float(residuals.full_scale.values[j])
        place = f"{residuals.runs[residuals.run[at[j]]]} row {residuals.row[at[j]]}"
        rows.append(
            (
                TableCell(name, mark="name"),
                TableCell(f"{format_significant(full, 5)} {units[name]}", kind),
                *(TableCell(f"{format_significant(value, 2)} %") for value in (sigma, 2 * sigma, float(largest[j]))),
                TableCell(place, mark="quiet"),
            )
        )
    caption = (
        f"Loads computed from the readings of the calibration, less the applied loads, in % of the "
        f"{residuals.full_scale.meaning}, by the {residuals.method}. {int(residuals.used.sum())} points; the standard "
        "deviation allows for the coefficients that were fitted."
    )
    return Table(caption, (plain_row(*words),), tuple(rows))


def series_table(residuals: LoadResiduals, series: tuple[LoadSeriesRows, ...]) -> Table:
    """Rms residual of each load series and component."""
    rows = []
    for entry in series:
        percent = residuals.percent[entry.rows]
        known = percent[np.isfinite(percent).all(axis=1)]
        cells = np.sqrt(np.mean(known**2, axis=0)) if len(known) else np.full(len(residuals.components), np.nan)
        texts = (format_significant(float(value), 2) if np.isfinite(value) else MISSING_VALUE for value in cells)
        rows.append(row_with_name(entry.words, *texts))
    caption = f"Rms residual in % of the {residuals.full_scale.meaning}; a dash: excluded."
    head = plain_row("load series", *residuals.components)
    return Table(caption, (head,), tuple(rows))


def residual_figure(residuals: LoadResiduals, series: tuple[LoadSeriesRows, ...]) -> Figure:
    """One panel per component: residual [% of full scale] against the number of the point."""
    figure, panels = _make_panels(len(residuals.components), "load point, in the order of loading")
    for j, axes in enumerate(panels):
        _draw_component(axes, residuals, series, j)
    return figure


def _make_panels(count: int, label: str) -> tuple[Figure, list[Axes]]:
    """The figure and one panel for each of `count` components."""
    columns = min(COLUMNS, count)
    lines = -(-count // columns)
    total = PANEL_INCHES * lines + LABEL_INCHES
    figure = new_figure(PAGE_INCHES, total)
    panels = figure.subplots(lines, columns, squeeze=False, sharex=True).ravel().tolist()
    for axes in panels[count:]:
        axes.set_axis_off()
    for j, axes in enumerate(panels[:count]):
        if j >= count - columns:
            axes.tick_params(axis="x", labelbottom=True)
            axes.set_xlabel(label)
        if j % columns == 0:
            axes.set_ylabel("residual [%]")
    figure.subplots_adjust(
        left=0.06, right=0.99, top=1 - 0.22 / total, bottom=LABEL_INCHES / total, wspace=0.14, hspace=0.34
    )
    return figure, panels[:count]


def _draw_component(axes: Axes, residuals: LoadResiduals, series: tuple[LoadSeriesRows, ...], j: int) -> None:
    percent, sigma = residuals.percent[:, j], float(residuals.standard_deviation[j])
    for n, entry in enumerate(series):
        if n % 2:
            axes.axvspan(*entry.ends, color=BAND, linewidth=0, zorder=0)
    axes.axhline(0.0, color=BLACK, linewidth=0.5, zorder=1)
    for sign in (-2.0, 2.0):
        axes.axhline(sign * sigma, color=BLACK, linewidth=0.6, linestyle=(0, (4, 3)), zorder=2)
    number = np.arange(1, len(percent) + 1)
    many = percent.size * len(residuals.components) > RASTERIZE_ABOVE
    axes.plot(number, percent, ".", color=BLUE, markersize=3.2, rasterized=many, zorder=3)
    largest, at = (values[j] for values in residuals.largest)
    axes.plot(number[at], largest, "o", markerfacecolor="none", color=VERMILION, markersize=6, zorder=4)
    limit = AXIS_MARGIN * max(float(np.nanmax(np.abs(percent))), 2.0 * sigma, np.finfo(float).tiny)
    axes.set_ylim(-limit, limit)
    axes.set_xlim(0.5, len(percent) + 0.5)
    axes.grid(visible=False, axis="x")
    axes.set_title(residuals.components[j], loc="left")
    text = f"s {format_significant(sigma, 2)} %, largest {format_significant(float(largest), 2)} %"
    axes.set_title(text, loc="right", fontsize=7.5, fontweight="normal", color="#555555")
