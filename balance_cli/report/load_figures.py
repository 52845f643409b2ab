"""Pictures of reduced hub loads: harmonics with sigma, and the residual test by harmonic."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS, UNIT_OF
from balance_cli.reduction.flags import REDUNDANCY
from balance_cli.reduction.result import HubLoads, RunLoads
from balance_cli.report.figure_style import (
    BLACK,
    BLUE,
    EXTRA_COLORS,
    GREEN,
    ORANGE,
    VERMILION,
    log_limits,
    new_figure,
    set_log_axis,
)
from balance_cli.report.sources import Source

Array = NDArray[np.float64]

RUN_COLORS = (BLUE, ORANGE, GREEN, VERMILION, *EXTRA_COLORS)
RUN_MARKERS = "osD^vPX*"


def wind_runs(loads: HubLoads) -> dict[str, RunLoads]:
    """The wind-on runs, whose loads are not known."""
    return {name: run for name, run in loads.runs.items() if run.check is None}


def amplitude_sigma(run: RunLoads) -> Array:
    """Sigma (n+1, m) of the amplitudes, from sigma of cosine and sine along the amplitude vector."""
    c, s = run.amplitude.real, -run.amplitude.imag
    size = np.where(np.abs(run.amplitude) > 0, np.abs(run.amplitude), 1.0)
    return np.asarray(np.hypot(c / size * run.sigma_cosine, s / size * run.sigma_sine))


def redundancy_figure(load_sources: Sequence[Source[HubLoads]]) -> Figure:
    """Chi-square per degree of freedom: one panel per run, one curve per method, the limit dashed."""
    names = list(dict.fromkeys(name for source in load_sources for name in wind_runs(source.content)))
    columns = min(len(names), 4)
    lines = -(-len(names) // columns)
    figure = new_figure(12.0, 2.5 * lines + 0.5)
    panels = figure.subplots(lines, columns, squeeze=False, sharey=True).ravel()
    all_runs = [run for source in load_sources for run in wind_runs(source.content).values()]
    values = np.concatenate([np.concatenate([run.redundancy, run.redundancy_limit]) for run in all_runs])
    for axes, name in zip(panels, names, strict=False):
        set_log_axis(axes, log_limits(values, 1.0, 1.5))
        axes.set_title(name)
        for source in load_sources:
            if name in wind_runs(source.content):
                _draw_redundancy(axes, source, wind_runs(source.content)[name])
        axes.set_xlabel("harmonic of the rotor")
    for axes in panels[len(names) :]:
        axes.set_axis_off()
    panels[0].set_ylabel("chi2 / dof of the residual test")
    handles = [
        Line2D([], [], marker=source.plot_style.marker, **source.plot_style.line_kwargs) for source in load_sources
    ]
    handles.append(Line2D([], [], color=BLACK, linestyle="--", linewidth=0.8))
    figure.legend(handles, [*(source.label for source in load_sources), "limit"], loc="lower center", ncols=6)
    bottom = 0.5 / (2.5 * lines + 0.5)
    figure.subplots_adjust(left=0.06, right=0.99, top=1 - 0.25 / lines / 2.5, bottom=bottom + 0.16 / lines, wspace=0.08)
    return figure


def _draw_redundancy(axes: Axes, source: Source[HubLoads], run: RunLoads) -> None:
    known = np.isfinite(run.redundancy)
    harmonic = np.arange(len(run.redundancy))
    axes.plot(harmonic[known], run.redundancy[known], marker=source.plot_style.marker, **source.plot_style.line_kwargs)
    axes.plot(harmonic[known], run.redundancy_limit[known], color=BLACK, linestyle="--", linewidth=0.8)
    axes.set_xticks(harmonic)


def harmonics_figure(loads: HubLoads) -> Figure:
    """One panel per component: amplitudes of harmonics 1 to n with sigma, one color per run."""
    runs = list(wind_runs(loads).values())
    names = [name for name in COMPONENTS if any(name in run.components for run in runs)]
    columns = min(len(names), 3)
    lines = -(-len(names) // columns)
    figure = new_figure(12.0, 2.1 * lines + 0.4)
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes, name in zip(panels, names, strict=False):
        axes.set_title(f"{name} [{UNIT_OF[name]}]")
        set_log_axis(axes, log_limits(_component_amplitudes(runs, name), 1.0, 1.4))
        for i, run in enumerate(runs):
            if name in run.components:
                _draw_amplitudes(axes, run, name, i, (i - (len(runs) - 1) / 2) * 0.7 / len(runs))
        axes.set_xticks(range(1, max(len(run.frequency_hz) for run in runs)))
        axes.grid(visible=False, axis="x")
    for axes in panels[len(names) :]:
        axes.set_axis_off()
    for axes in panels[max(len(names) - columns, 0) : len(names)]:
        axes.set_xlabel("harmonic of the rotor")
    handles = [Line2D([], [], color=_run_color(i), marker=_run_marker(i), linestyle="") for i in range(len(runs))]
    figure.legend(handles, [run.run for run in runs], loc="lower center", ncols=8)
    inch = 2.1 * lines + 0.4
    figure.subplots_adjust(left=0.05, right=0.99, top=1 - 0.22 / inch, bottom=0.62 / inch, wspace=0.15, hspace=0.3)
    return figure


def _component_amplitudes(runs: Sequence[RunLoads], name: str) -> Array:
    """All amplitudes of a component, of harmonics 1 to n."""
    columns = [run.amplitude[1:, run.components.index(name)] for run in runs if name in run.components]
    return np.abs(np.concatenate(columns))


def _run_color(i: int) -> str:
    return RUN_COLORS[i % len(RUN_COLORS)]


def _run_marker(i: int) -> str:
    return RUN_MARKERS[i % len(RUN_MARKERS)]


def _draw_amplitudes(axes: Axes, run: RunLoads, name: str, i: int, shift: float) -> None:
    m = run.components.index(name)
    amplitude = np.abs(run.amplitude[1:, m])
    sigma = amplitude_sigma(run)[1:, m]
    flagged = np.array([REDUNDANCY in flags[m] for flags in run.flags[1:]])
    place = np.arange(1, len(run.frequency_hz)) + shift
    low = np.minimum(sigma, 0.9 * amplitude)
    axes.vlines(place, amplitude - low, amplitude + sigma, colors=_run_color(i), linewidth=1.0)
    for selection, face in ((~flagged, _run_color(i)), (flagged, "white")):
        axes.plot(
            place[selection],
            amplitude[selection],
            linestyle="",
            marker=_run_marker(i),
            color=_run_color(i),
            markerfacecolor=face,
        )
