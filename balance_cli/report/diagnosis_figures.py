"""Pictures of a diagnosis: errors on the hold-out runs, and the residual before and after, by run and by channel."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator
from numpy.typing import NDArray

from balance_cli.diagnosis.result import Diagnosis, ResidualMap
from balance_cli.report.check_errors import ERROR_KINDS
from balance_cli.report.check_figures import MethodBars, error_figure
from balance_cli.report.diagnosis_errors import STAGES, pooled_hold_out_errors
from balance_cli.report.figure_style import PURPLE, VERMILION, new_figure

Array = NDArray[np.float64]

COLOR_MIN, COLOR_MAX = 1.0, 10.0
"""Limits of the color scale: the noise level is light; the upper limit holds where no residual is larger."""
ROW_INCHES = 0.17
MARGIN_INCHES = 0.42
FREQUENCY_TICKS = 8
ZERO_FREQUENCY_LIMIT = 1e-3
"""Band edges [Hz] below this are labeled as frequency zero."""
FINE_TICKS_LIMIT = 300.0
"""With a largest residual below this the color bar has ticks at 1, 2 and 5 in every decade."""


def hold_out_figure(diagnosis: Diagnosis) -> Figure:
    """Bars before and after by component, pooled over the hold-out runs; black marks: noise floor."""
    bars = [
        MethodBars(
            f"{stage} updating", color, {kind: pooled_hold_out_errors(diagnosis, stage, kind) for kind in ERROR_KINDS}
        )
        for stage, color in zip(STAGES, (VERMILION, PURPLE), strict=True)
    ]
    return error_figure(bars, " on the hold-out runs", height=3.2)


def residual_figure(residual: ResidualMap) -> Figure:
    """Heat maps over frequency: runs down in the upper row, channels down in the lower; before left, after right."""
    rows = (len(residual.runs), len(residual.channels))
    inches = [ROW_INCHES * count + MARGIN_INCHES for count in rows]
    figure = new_figure(12.0, sum(inches) + 0.55)
    axes = figure.subplots(2, 2, sharex=True, sharey="row", gridspec_kw={"height_ratios": rows})
    stages = (residual.before, residual.after)
    panels = [_rms_over(stage, axis) for axis in (2, 0) for stage in stages]
    largest = max(COLOR_MAX, *(float(np.nanmax(panel, initial=0.0)) for panel in panels))
    norm = LogNorm(COLOR_MIN, largest)
    names = [residual.runs, residual.runs, residual.channels, residual.channels]
    titles = ["Before: runs", "After: runs", "Before: channels", "After: channels"]
    for ax, panel, labels, title in zip(axes.flat, panels, names, titles, strict=True):
        image = _draw_heat_map(ax, panel, labels, norm)
        ax.set_title(title)
    for ax in axes[1]:
        _frequency_axis(ax, residual.edges)
    total = sum(inches) + 0.55
    figure.subplots_adjust(left=0.12, right=0.925, top=1 - 0.25 / total, bottom=0.5 / total, wspace=0.03, hspace=0.2)
    place = figure.add_axes((0.94, 0.5 / total, 0.012, 1 - 0.75 / total))
    ticks = LogLocator(subs=(1.0, 2.0, 5.0) if largest < FINE_TICKS_LIMIT else (1.0,))
    bar = figure.colorbar(image, cax=place, ticks=ticks, format=FuncFormatter(lambda value, _: f"{value:g}"))
    bar.minorticks_off()
    bar.set_label("rms residual over noise")
    bar.outline.set_visible(False)
    return figure


def _rms_over(values: Array, axis: int) -> Array:
    """Rms of (runs, bands, channels) over channels (axis 2) or runs (axis 0), as rows by bands; NaN for no line."""
    has_lines = np.isfinite(values)
    count = has_lines.sum(axis=axis)
    total = np.where(has_lines, np.square(values), 0.0).sum(axis=axis)
    rms = np.sqrt(np.divide(total, count, out=np.full(count.shape, np.nan), where=count > 0))
    return np.asarray(rms if axis == 2 else rms.T)


def _draw_heat_map(axes: Axes, values: Array, labels: tuple[str, ...], norm: LogNorm) -> Any:
    """Draw one heat map; all bands are equally wide, so that frequency zero is visible."""
    image = axes.imshow(values, aspect="auto", interpolation="nearest", cmap="magma_r", norm=norm)
    axes.set_facecolor("#eceff1")
    axes.set_yticks(range(len(labels)), labels, fontsize=7)
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False)
    return image


def _frequency_axis(axes: Axes, edges: Array) -> None:
    """Label some edges of the bands."""
    step = max(1, round((len(edges) - 1) / FREQUENCY_TICKS))
    index = np.arange(0, len(edges), step)
    plain = (edges < ZERO_FREQUENCY_LIMIT) | (edges > 10.0)
    axes.set_xticks(index - 0.5, [f"{edges[i]:.0f}" if plain[i] else f"{edges[i]:.3g}" for i in index])
    axes.set_xlabel("edges of the bands [Hz]")
