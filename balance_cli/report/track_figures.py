"""Figures of loads in time: means and amplitudes from revolution to revolution, with sigma."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS, UNIT_OF
from balance_cli.reduction.kalman.load_history import LoadTrack
from balance_cli.reduction.result import RunLoads
from balance_cli.report.figure_style import (
    BLACK,
    BLUE,
    EXTRA_COLORS,
    GRAY,
    GREEN,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    new_figure,
)
from balance_cli.report.number_format import format_significant

Array = NDArray[np.float64]

HARMONICS_SHOWN = 3
"""Harmonics drawn of each component."""
HARMONIC_COLORS = (BLUE, ORANGE, GREEN, VERMILION, SKY, PURPLE, *EXTRA_COLORS)
ROW_INCHES_OF_COMPONENT = 3.2
"""Height [in] of a row of panels."""
BAND_OPACITY = 0.25
"""Opacity of a band of one sigma."""


def strongest_harmonics(track: LoadTrack, component: int) -> tuple[int, ...]:
    """Return the harmonics of a component (its column) with the largest mean square amplitude, in rising order."""
    power = np.nan_to_num(np.nanmean(np.abs(track.amplitude[:, 1:, component]) ** 2, axis=0))
    return tuple(sorted(int(n) + 1 for n in np.argsort(-power, kind="stable")[:HARMONICS_SHOWN]))


def track_figure(run: RunLoads, track: LoadTrack) -> Figure:
    """Draw one panel per component: means of revolutions above, changes of its strongest harmonics below.

    A change is an amplitude less its mean over the steady part, which the legend states.
    """
    names = [name for name in COMPONENTS if name in run.components]
    columns = min(len(names), 3)
    lines = -(-len(names) // columns)
    total = ROW_INCHES_OF_COMPONENT * lines
    figure = new_figure(12.0, total)
    bottom, top = 0.4 / total, 1 - 0.25 / total
    grid = figure.add_gridspec(lines, columns, left=0.05, right=0.99, top=top, bottom=bottom, wspace=0.17, hspace=0.22)
    for i, name in enumerate(names):
        column = run.components.index(name)
        _draw_track_panel(
            figure, grid[i // columns, i % columns], track, column, f"{name} [{UNIT_OF[name]}]", run.interval
        )
    for axes in figure.axes[1::2][-columns:]:
        axes.set_xlabel("time [s]")
    return figure


def _draw_track_panel(
    figure: Figure, spec: SubplotSpec, track: LoadTrack, column: int, title: str, interval: tuple[float, float]
) -> None:
    inner = spec.subgridspec(2, 1, height_ratios=(1.0, 1.3), hspace=0.3)
    upper, lower = (figure.add_subplot(inner[row]) for row in range(2))
    upper.set_title(title)
    _draw_band(upper, track.time, track.amplitude[:, 0, column].real, track.sigma[:, 0, column], BLACK)
    inside = (track.time >= interval[0]) & (track.time <= interval[1])
    for n in strongest_harmonics(track, column):
        amplitude, sigma = np.abs(track.amplitude[:, n, column]), track.sigma[:, n, column]
        mean = float(np.nanmean(amplitude[inside]))
        _draw_band(
            lower, track.time, amplitude - mean, sigma, harmonic_color(n), f"{n}/rev, {format_significant(mean)}"
        )
    lower.legend(loc="lower left", bbox_to_anchor=(0.0, 0.96), ncols=HARMONICS_SHOWN, borderpad=0.0, columnspacing=1.2)
    for axes in (upper, lower):
        axes.set_xlim(float(track.time[0]), float(track.time[-1]))
        for edge in interval:
            axes.axvline(edge, color=GRAY, linewidth=0.7, linestyle=(0, (4, 2)))
    upper.tick_params(axis="x", labelbottom=False)
    # The text of an offset would cover the title.
    upper.ticklabel_format(axis="y", useOffset=False)
    if spec.is_first_col():
        upper.set_ylabel("mean")
        lower.set_ylabel("change")
        figure.align_ylabels([upper, lower])


def _draw_band(axes: Axes, time: Array, value: Array, sigma: Array, color: str, label: str = "") -> None:
    axes.fill_between(time, value - sigma, value + sigma, color=color, alpha=BAND_OPACITY, linewidth=0, rasterized=True)
    axes.plot(time, value, color=color, linewidth=0.9, label=label, rasterized=True)


def harmonic_color(n: int) -> str:
    """The color of a harmonic wherever it is drawn."""
    return HARMONIC_COLORS[(n - 1) % len(HARMONIC_COLORS)]
